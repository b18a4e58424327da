"""The service behind the Caddy of docker/Caddyfile, with TLS by Caddy's own authority."""

from __future__ import annotations

import json
import os
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from tests.local_servers import QuietHandler, free_port, free_ports, http_server
from tests.service.conftest import StartApp, localise, upload, wait_for

CONFIGURATION = Path(__file__).parents[2] / "docker" / "Caddyfile"


@dataclass(frozen=True)
class Proxy:
    """Running Caddy: a client that trusts its authority, and the port without TLS."""

    client: httpx.Client
    plain_port: int


@contextmanager
def caddy(folder: Path, upstream: str) -> Iterator[Proxy]:
    """Run Caddy as configured, but for its ports."""
    program = shutil.which("caddy")
    if program is None:
        pytest.skip("Caddy is not installed; on Debian and Ubuntu the package is caddy")
    plain, secure = free_ports(2)
    environment = os.environ | {
        "XDG_DATA_HOME": str(folder),
        "XDG_CONFIG_HOME": str(folder),
        "LALALOC_HOST": "localhost",
        "LALALOC_UPSTREAM": upstream,
        "LALALOC_HTTP_PORT": str(plain),
        "LALALOC_HTTPS_PORT": str(secure),
    }
    log = folder / "caddy.log"
    with log.open("wb") as output:
        command = [program, "run", "--config", str(CONFIGURATION), "--adapter", "caddyfile"]
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
    root = folder / "caddy" / "pki" / "authorities" / "local" / "root.crt"
    try:
        wait_for(lambda: process.poll() is not None or (root.exists() and _has_certificate(secure, root)))
        assert process.poll() is None, log.read_text(encoding="utf-8")
        context = ssl.create_default_context(cafile=str(root))
        with httpx.Client(base_url=f"https://localhost:{secure}", verify=context, timeout=30.0) as client:
            yield Proxy(client, plain)
    finally:
        process.terminate()
        process.wait(30.0)


def _has_certificate(port: int, root: Path) -> bool:
    """Tell whether Caddy completes a handshake; it listens before it has signed a certificate."""
    try:
        context = ssl.create_default_context(cafile=str(root))
        with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
            context.wrap_socket(connection, server_hostname="localhost").close()
    except OSError:
        return False
    return True


@pytest.mark.one_replica
def test_service_answers_over_tls(start_app: StartApp, sphere: bytes, tmp_path: Path) -> None:
    with start_app(tmp_path / "data") as app, caddy(tmp_path, urlsplit(str(app.base_url)).netloc) as proxy:
        answer = localise(proxy.client, upload(proxy.client), sphere, heading_deg=0)
        assert answer.status_code == 200, answer.text
        assert answer.headers["strict-transport-security"] == "max-age=31536000"
        assert "caddy" not in answer.headers.get("server", "").lower()
        # Metrics stay inside; everything else is the service's, with its own problems.
        assert app.get("/metrics").status_code == 200
        assert proxy.client.get("/metrics").status_code == 404
        assert proxy.client.get(f"/floorplans/{'0' * 32}").json()["type"] == "urn:lalaloc:problem:unknown-floorplan"
        # Without TLS there is only a redirect.
        redirect = httpx.get(f"http://localhost:{proxy.plain_port}/floorplans")
        assert redirect.status_code == 308
        assert redirect.headers["location"].startswith("https://localhost")


def test_client_cannot_state_its_address(tmp_path: Path) -> None:
    received: list[str] = []

    class Upstream(QuietHandler):
        def do_GET(self) -> None:
            received.extend(self.headers.get_all("X-Forwarded-For") or [])
            self.send_response(204)
            self.end_headers()

    with http_server(Upstream) as upstream, caddy(tmp_path, urlsplit(upstream).netloc) as proxy:
        assert proxy.client.get("/", headers={"X-Forwarded-For": "203.0.113.7"}).status_code == 204
    assert len(received) == 1
    assert received[0] in ("127.0.0.1", "::1")


def test_proxy_without_service_answers_with_a_problem(tmp_path: Path) -> None:
    with caddy(tmp_path, f"127.0.0.1:{free_port()}") as proxy:
        answer = proxy.client.get("/floorplans")
    assert answer.status_code == 502
    assert answer.headers["content-type"] == "application/problem+json"
    assert json.loads(answer.text)["status"] == 502
