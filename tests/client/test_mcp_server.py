"""`lalaloc mcp` with the protocol's own client, over stdio and over HTTP, with the production app behind it."""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import httpx2
import mcp
import pytest
from mcp.client.stdio import StdioServerParameters
from mcp.client.streamable_http import streamable_http_client

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


def test_plan_is_imported_and_photographs_are_localised(app: httpx.Client, flat: Path, photograph: Path) -> None:
    async def talk(client: Any) -> None:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        names = {"import_plan", "list_plans", "localise_photograph", "localise_turn", "pin_folder", "next_step"}
        assert set(tools) == names
        assert all(tool.description for tool in tools.values())
        plan = _said(await client.call_tool("import_plan", {"plan": str(flat)}))
        assert plan["status"] == "ready"
        assert [room["name"] for room in plan["rooms"]] == [room["name"] for room in FLAT["rooms"]]
        listed = _said(await client.call_tool("list_plans", {}))
        assert plan["id"] in {item["id"] for item in listed}
        asked = {"photograph": str(photograph), "floorplan_id": plan["id"], "heading_deg": 30.0}
        found = await client.call_tool("localise_photograph", asked)
        answer = _said(found)
        assert answer["floorplan_id"] == plan["id"]
        assert answer["heading_deg"] is not None
        (picture,) = [part for part in found.content if part.type == "image"]
        assert base64.b64decode(picture.data).startswith(b"\x89PNG")
        step = _said(await client.call_tool("next_step", {"photograph": str(photograph), "floorplan_id": plan["id"]}))
        assert "confidence" in step

    _over_stdio(str(app.base_url), talk)


def test_turn_of_photographs_is_localised(app: httpx.Client, flat: Path) -> None:
    async def talk(client: Any) -> None:
        plan = _said(await client.call_tool("import_plan", {"plan": str(flat)}))
        shown = _JPEG + base64.b64encode(encode_picture(640, 480, "JPEG")).decode()
        asked = {"photographs": [shown, shown], "floorplan_id": plan["id"], "hfov_deg": 70.0}
        answer = _said(await client.call_tool("localise_turn", asked))
        assert len(answer["poses"]) == 2

    _over_stdio(str(app.base_url), talk)


@pytest.mark.slow
def test_folder_is_pinned(start_app: StartApp, flat: Path, tmp_path: Path, sphere: bytes) -> None:
    folder = tmp_path / "visit"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(sphere)
    (folder / "b.png").write_bytes(encode_picture(256, 128, "PNG"))
    (folder / "c.jpg").write_bytes(b"no photograph")
    (folder / "notes.txt").write_text("left out")

    async def talk(client: Any) -> None:
        plan = _said(await client.call_tool("import_plan", {"plan": str(flat)}))
        found = await client.call_tool("pin_folder", {"folder": str(folder), "floorplan_id": plan["id"]})
        told = _said(found)
        assert [pin["photograph"] for pin in told["pins"]] == ["a.jpg", "b.png"]
        assert {pin["state"] for pin in told["pins"]} <= {"sure", "uncertain", "set_aside"}
        assert [refused["photograph"] for refused in told["refused"]] == ["c.jpg"]
        assert _texts(found)[1].startswith("<svg")
        listed = app.get(f"/albums/{told['album_id']}/photographs").json()["photographs"]
        assert [row["name"] for row in listed] == ["a.jpg", "b.png"]

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
