"""Command line of the service: `lalaloc-service serve`, `keys`, `tenants`, `compact`, `backup` and `restore`.

Keys and tenants are in the database of the settings, so these commands also work while the service runs.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime

from lalaloc_core.errors import ConfigError, LaLaLocError
from lalaloc_core.localise.bundle import Bundle
from service.backup_commands import add_backup_commands
from service.command_parts import configured_store, tenant_name, text_table
from service.security import Permission, check_address
from service.security.keys import hash_of, key_text, new_secret
from service.settings import Settings
from service.storage import open_store
from service.storage.records import ApiKey
from service.telemetry.tracing import otlp_exporter
from service.tenant_commands import add_tenant_commands

# Connections that the kernel accepts while the service is busy.
_BACKLOG = 1024
_MAX_NAME = 200
_MAX_RATE = 10**6


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0, or 1 after an error; a usage error exits with 2."""
    parsed = build_parser().parse_args(arguments)
    try:
        return parsed.run(parsed)
    except LaLaLocError as error:
        print(f"lalaloc-service: {error}", file=sys.stderr)
        return 1


def add_serve_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `serve`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on, 0 for a free one (default: 8000)")


def serve(arguments: argparse.Namespace) -> int:
    """Bind, print the address, and serve until stopped.

    Raises:
        ConfigError: an invalid setting, or a public address without keys.
    """
    settings = Settings.load()
    with _listener(arguments.host, arguments.port) as listener:
        host, port = listener.getsockname()[:2]
        check_address(host, settings)
        _check_parts(settings)
        # The socket is bound, so clients can connect now; they are answered after the start.
        print(f"http://{f'[{host}]' if ':' in host else host}:{port}", flush=True)
        # Imported late, because it takes a second that help and keys do not need.
        from service.app import create_app
        from service.http.server import Server, server_config

        app = create_app(settings)
        Server(server_config(app, settings), app, settings).run(sockets=[listener])
    return 0


def _check_parts(settings: Settings) -> None:
    """Check model, database and exporter before the start, so that errors are one line and not a log.

    Raises:
        BundleError: no usable model.
        ConfigError, StoreUnavailableError: no usable database or exporter.
    """
    if settings.otlp_endpoint is not None:
        otlp_exporter(settings.otlp_endpoint).shutdown()
    Bundle.open(settings.bundle).check()
    open_store(settings).close()


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"cannot listen on {host} port {port}: {error}") from error


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="lalaloc-service", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    serving = commands.add_parser("serve", help="run the service")
    add_serve_arguments(serving)
    serving.set_defaults(run=serve)
    keys = commands.add_parser("keys", help="create, list and revoke API keys").add_subparsers(required=True)

    create = keys.add_parser("create", help="create a key and print it; it cannot be shown again")
    create.add_argument(
        "--tenant", required=True, type=tenant_name, help="tenant whose floor plans the key gives access to"
    )
    create.add_argument("--name", required=True, type=_name, help="name of the key, for your own records")
    create.add_argument(
        "--scope",
        dest="scopes",
        action="append",
        required=True,
        choices=[str(permission) for permission in Permission],
        help="scope of the key; repeat the option for several",
    )
    create.add_argument(
        "--rate-per-minute",
        type=_rate,
        help="rate limit in requests per minute; 0: no limit (default: LALALOC_RATE_PER_MINUTE)",
    )
    create.set_defaults(run=_create)

    listing = keys.add_parser("list", help="list all keys, including revoked ones, without secrets")
    listing.add_argument("--tenant", type=tenant_name, help="list only the keys of this tenant")
    listing.add_argument("--json", action="store_true", help="print JSON instead of a table")
    listing.set_defaults(run=_list)

    revoke = keys.add_parser("revoke", help="revoke a key; it is rejected within LALALOC_KEY_CACHE_S")
    revoke.add_argument("id", help="id of the key: the part between the underscores")
    revoke.set_defaults(run=_revoke)
    add_tenant_commands(commands)
    add_backup_commands(commands)
    return parser


def _create(arguments: argparse.Namespace) -> int:
    secret = new_secret()
    with configured_store() as store:
        key = store.keys.create(
            arguments.tenant,
            arguments.name,
            hash_of(secret),
            arguments.scopes,
            rate_per_minute=arguments.rate_per_minute,
        )
    # Only the key goes to standard output, so that it can be piped.
    print(f"key {key.id} of tenant '{key.tenant}'; it is shown only once:", file=sys.stderr)
    print(key_text(key.id, secret))
    return 0


def _list(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        keys = store.keys.list_keys(arguments.tenant)
    if arguments.json:
        print(json.dumps([asdict(key) | {"scopes": sorted(key.scopes)} for key in keys], default=str, indent=2))
    else:
        print(_table(keys))
    return 0


def _revoke(arguments: argparse.Namespace) -> int:
    with configured_store() as store:
        if not store.keys.revoke(arguments.id):
            print(f"lalaloc-service: no active key '{arguments.id[:64]}'", file=sys.stderr)
            return 1
    print(f"revoked {arguments.id}")
    return 0


def _table(keys: Sequence[ApiKey]) -> str:
    head = ("ID", "TENANT", "NAME", "SCOPES", "RATE", "CREATED", "LAST USED", "REVOKED")
    rows = [
        (
            key.id,
            key.tenant,
            key.name,
            ",".join(sorted(key.scopes)),
            "-" if key.rate_per_minute is None else str(key.rate_per_minute),
            _moment(key.created_at),
            _moment(key.last_used_at),
            _moment(key.revoked_at),
        )
        for key in keys
    ]
    return text_table(head, rows)


def _moment(moment: datetime | None) -> str:
    return "-" if moment is None else moment.isoformat(timespec="seconds")


def _name(given: str) -> str:
    if not 0 < len(given) <= _MAX_NAME or not given.isprintable():
        raise argparse.ArgumentTypeError(f"1 to {_MAX_NAME} printable characters")
    return given


def _rate(given: str) -> int:
    if not given.isascii() or not given.isdigit() or int(given) > _MAX_RATE:
        raise argparse.ArgumentTypeError(f"a whole number from 0 to {_MAX_RATE}")
    return int(given)


if __name__ == "__main__":
    sys.exit(main())
