"""`lalaloc mcp` with the protocol's own client, over stdio and over HTTP, with the production app behind it."""

from __future__ import annotations

import argparse
import asyncio
import base64
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import httpx2
import mcp
import pytest
from mcp.client.stdio import StdioServerParameters
from mcp.client.streamable_http import streamable_http_client

from lalaloc_client import mcp_server
from lalaloc_core.bundle import default_bundle
from service.storage import Store
from tests.local_servers import free_port
from tests.service.conftest import FLAT, DatabaseOf, StartApp, encode_picture, wait_for
from tests.service.test_security import bearer, make_key

_COMMAND = [sys.executable, "-c", "import sys; from lalaloc_core.cli import main; sys.exit(main())", "mcp"]
_JPEG = "data:image/jpeg;base64,"
APP_SETTINGS = {"bundle": "tiny_view_bundle"}


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    file = tmp_path / "flat.json"
    file.write_text(json.dumps(FLAT))
    return file


@pytest.fixture
def photograph(tmp_path: Path, sphere: bytes) -> Path:
    file = tmp_path / "room.jpg"
    file.write_bytes(sphere)
    return file


def _over_stdio(url: str, talk: Callable[[Any], Awaitable[None]]) -> None:
    async def run() -> None:
        parameters = StdioServerParameters(command=_COMMAND[0], args=[*_COMMAND[1:], "--url", url])
        async with mcp.Client(parameters) as client:
            await talk(client)

    asyncio.run(run())


def _texts(result: Any) -> list[str]:
    return [part.text for part in result.content if part.type == "text"]


def _said(result: Any) -> Any:
    assert not result.is_error, result.content
    return json.loads(_texts(result)[0])


def test_plan_is_imported_and_photographs_and_turns_are_localised(
    app: httpx.Client, flat: Path, photograph: Path
) -> None:
    async def talk(client: Any) -> None:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        names = {"import_plan", "list_plans", "localise_photograph", "localise_turn", "pin_folder", "next_step"}
        assert set(tools) == names
        assert all(tool.description for tool in tools.values())
        plan = _said(await client.call_tool("import_plan", {"plan": str(flat)}))
        assert plan["status"] == "ready"
        assert [room["name"] for room in plan["rooms"]] == [room["name"] for room in FLAT["rooms"]]
        listed = _said(await client.call_tool("list_plans", {}))
        assert (plan["id"], 1) in {(item["id"], item["revision_number"]) for item in listed}
        asked = {"photograph": str(photograph), "floorplan_id": plan["id"], "heading_deg": 30.0}
        found = await client.call_tool("localise_photograph", asked)
        answer = _said(found)
        assert answer["floorplan_id"] == plan["id"]
        assert answer["heading_deg"] is not None
        (picture,) = [part for part in found.content if part.type == "image"]
        assert base64.b64decode(picture.data).startswith(b"\x89PNG")
        step = _said(await client.call_tool("next_step", {"photograph": str(photograph), "floorplan_id": plan["id"]}))
        assert "confidence" in step
        shown = _JPEG + base64.b64encode(encode_picture(640, 480, "JPEG")).decode()
        asked = {"photographs": [shown, shown], "floorplan_id": plan["id"], "hfov_deg": 70.0}
        assert len(_said(await client.call_tool("localise_turn", asked))["poses"]) == 2

    _over_stdio(str(app.base_url), talk)


@pytest.mark.slow
def test_folder_is_pinned(start_app: StartApp, flat: Path, tmp_path: Path, sphere: bytes) -> None:
    folder = tmp_path / "visit"
    folder.mkdir()
    (folder / "9.jpg").write_bytes(sphere)
    (folder / "10.png").write_bytes(encode_picture(256, 128, "PNG"))
    (folder / "c\udcff.jpg").write_bytes(b"no photograph")
    for name in ("notes.txt", "._9.jpg"):
        (folder / name).write_text("left out")

    async def talk(client: Any) -> None:
        plan = _said(await client.call_tool("import_plan", {"plan": str(flat)}))
        found = await client.call_tool("pin_folder", {"folder": str(folder), "floorplan_id": plan["id"]})
        told = _said(found)
        assert [pin["photograph"] for pin in told["pins"]] == ["9.jpg", "10.png"]
        assert {pin["state"] for pin in told["pins"]} <= {"sure", "uncertain", "set_aside"}
        assert [refused["photograph"] for refused in told["refused"]] == ["c?.jpg"]
        assert _texts(found)[1].startswith("<svg")
        listed = app.get(f"/albums/{told['album_id']}/photographs").json()["photographs"]
        assert [row["name"] for row in listed] == ["9.jpg", "10.png"]

    # Albums need the fitted weights of the shipped model.
    with start_app(tmp_path / "data", bundle=default_bundle()) as app:
        _over_stdio(str(app.base_url), talk)


_BAD_INPUT: list[tuple[str, dict[str, Any], str]] = [
    ("localise_photograph", {"photograph": "/missing.jpg", "floorplan_id": "x"}, "give the full path"),
    ("localise_photograph", {"photograph": _JPEG + "###", "floorplan_id": "x"}, "not valid base64"),
    ("localise_photograph", {"photograph": "data:text/plain,hello", "floorplan_id": "x"}, "base64"),
    ("localise_photograph", {"photograph": _JPEG + "aGVsbG8="}, "list_plans names the stored plans"),
    ("localise_photograph", {"photograph": _JPEG + "aGVsbG8=", "floorplan_id": "unknown"}, "unknown"),
    ("import_plan", {"plan": "data:text/plain;base64,aGVsbG8="}, "plan"),
    ("localise_turn", {"floorplan_id": "x"}, "either photographs or film"),
    ("localise_turn", {"floorplan_id": "x", "photographs": [_JPEG + "aGVsbG8="]}, "2 to 64"),
    ("pin_folder", {"floorplan_id": "x"}, "either folder or photographs"),
    ("pin_folder", {"floorplan_id": "x", "folder": "/missing"}, "no folder '/missing'"),
    ("pin_folder", {"floorplan_id": "x", "photographs": []}, "1 to 500"),
    ("localise_turn", {"floorplan_id": "x", "film": _JPEG + "aGVsbG8="}, ""),
]


def test_bad_input_is_an_error_of_the_tool_with_the_remedy(app: httpx.Client) -> None:
    async def talk(client: Any) -> None:
        for tool, arguments, remedy in _BAD_INPUT:
            result = await client.call_tool(tool, arguments)
            assert result.is_error
            (text,) = _texts(result)
            assert remedy in text
            assert "Traceback" not in text
            # The SDK names no cause of a crash.
            assert text.startswith(f"Error executing tool {tool}: ")

    _over_stdio(str(app.base_url), talk)


@pytest.mark.slow
def test_service_that_does_not_run_is_named(photograph: Path) -> None:
    async def talk(client: Any) -> None:
        asked = {"photograph": str(photograph), "floorplan_id": "x"}
        result = await client.call_tool("localise_photograph", asked)
        assert result.is_error
        assert "127.0.0.1" in _texts(result)[0]

    _over_stdio(f"http://127.0.0.1:{free_port()}", talk)


def test_http_passes_the_callers_key_on_and_reads_no_files(
    start_app: StartApp, database_of: DatabaseOf, tmp_path: Path, flat: Path
) -> None:
    with start_app(tmp_path / "data", api_keys=True, key_cache_s=0.0) as app:
        store = Store(database_of(tmp_path / "data"))
        key = make_key(store)
        store.close()
        port = free_port()
        command = [*_COMMAND, "--url", str(app.base_url), "--http", f"127.0.0.1:{port}"]
        # A key of the server's own must not serve callers.
        server = subprocess.Popen(command, env={"LALALOC_API_KEY": key, "PATH": ""}, stderr=subprocess.DEVNULL)
        try:
            wait_for(lambda: _listens(port) or server.poll() is not None)
            document = "data:application/json;base64," + base64.b64encode(flat.read_bytes()).decode()
            asyncio.run(_over_http(port, {}, document, str(flat), allowed=False))
            asyncio.run(_over_http(port, bearer(key), document, str(flat), allowed=True))
        finally:
            server.terminate()
            server.wait()


async def _over_http(port: int, headers: dict[str, str], document: str, path: str, *, allowed: bool) -> None:
    async with httpx2.AsyncClient(headers=headers, timeout=60.0) as http:
        transport = streamable_http_client(f"http://127.0.0.1:{port}/mcp", http_client=http)
        async with mcp.Client(transport) as client:
            result = await client.call_tool("import_plan", {"plan": document})
            assert result.is_error is not allowed
            if not allowed:
                assert "key" in _texts(result)[0]
            refused = await client.call_tool("import_plan", {"plan": path})
            assert refused.is_error
            assert "data URL" in _texts(refused)[0]


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def http_port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Return the port of a server over HTTP with small limits."""
    for name, limit in {
        "_MAX_BODY_BYTES": 3000,
        "_MAX_RECEIVED_BYTES": 4000,
        "_MAX_CONNECTIONS": 3,
        "_MAX_VALUES": 90,
    }.items():
        monkeypatch.setattr(mcp_server, name, limit)
    port = free_port()
    server = mcp_server.make_http_server(f"http://127.0.0.1:{port}", "127.0.0.1", port)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        wait_for(lambda: server.started)
        yield port
    finally:
        server.should_exit = True
        thread.join()


def _sent(port: int, text: str) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=20.0)
    connection.sendall(text.encode())
    return connection


def _head(*lines: str, method: str = "POST", host: str = "127.0.0.1:8765") -> str:
    stated = (f"{method} /mcp HTTP/1.1", f"Host: {host}", "Content-Type: application/json", *lines)
    return "\r\n".join(stated) + "\r\n\r\n"


@pytest.mark.parametrize(
    ("request_text", "status"),
    [
        (_head("Content-Length: 9", host="rebound.example:8765"), b"421"),
        (_head("Content-Length: 9", "Origin: https://page.example"), b"403"),
        (_head("Content-Length: 9", "Origin: http://localhost.page.example:80"), b"403"),
        (_head("Content-Length: 3001"), b"413"),
        (_head("Transfer-Encoding: chunked") + f"bb9\r\n{'a' * 3001}\r\n", b"413"),
        (_head("Content-Length: 999") + 40 * "[{},", b"413"),
        (_head(method="GET"), b"405"),
    ],
)
def test_http_refuses_requests_before_their_bodies_end(http_port: int, request_text: str, status: bytes) -> None:
    with _sent(http_port, request_text) as connection:
        assert connection.recv(4096).split()[1] == status


def test_http_bounds_the_bodies_of_all_requests_together(http_port: int) -> None:
    half = _head("Content-Length: 3000") + "a" * 2500

    def status(text: str) -> bytes:
        with _sent(http_port, text) as connection:
            return connection.recv(4096).split()[1]

    with _sent(http_port, half):
        assert status(half) == b"503"
    # The body counts until the server notices the disconnect.
    wait_for(lambda: status(half + "a" * 500) == b"406")


@pytest.mark.parametrize(
    "part", ["", "POST /mcp HT", _head(method="GET") + "POST /mcp HT", _head("Content-Length: 9") + "half"]
)
def test_http_ends_connections_that_send_no_whole_request(
    http_port: int, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_HEAD_S", "_BODY_S"):
        monkeypatch.setattr(mcp_server, name, 0.5)
    with _sent(http_port, part) as connection, connection.makefile("rb") as answers:
        assert answers.read().count(b"HTTP/1.1") == part.count("GET")


def test_http_bounds_connections(http_port: int) -> None:
    with ExitStack() as stack:
        connections = [stack.enter_context(_sent(http_port, "")) for _ in range(4)]
        assert connections[-1].recv(4096) == b""
        connections[0].sendall(_head(method="GET").encode())
        assert connections[0].recv(4096).split()[1] == b"405"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "[::]", "service.example"])
def test_http_listens_on_loopback_addresses_only(host: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="reverse proxy with TLS"):
        mcp_server._address(f"{host}:8765")
    assert mcp_server._address("[::1]:8765") == ("::1", 8765)
