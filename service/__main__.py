"""Run the service: `python -m service [--host HOST] [--port PORT]`; port 0 picks a free one."""

from __future__ import annotations

import argparse
import socket

import uvicorn

from service.settings import settings_table


def main() -> None:
    """Bind, say where, serve until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m service", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on, 0 for a free one (default: 8000)")
    parser.add_argument("--settings", action="store_true", help="print all settings as a Markdown table and exit")
    arguments = parser.parse_args()
    if arguments.settings:
        print(settings_table(), end="")
        return
    family = socket.AF_INET6 if ":" in arguments.host else socket.AF_INET
    with socket.create_server((arguments.host, arguments.port), family=family, backlog=128) as listener:
        host, port = listener.getsockname()[:2]
        # Bound already: whoever reads this line can connect, and is answered once the service has started.
        print(f"http://{f'[{host}]' if family == socket.AF_INET6 else host}:{port}", flush=True)
        uvicorn.Server(uvicorn.Config("service.app:app", log_level="warning")).run(sockets=[listener])


if __name__ == "__main__":
    main()
