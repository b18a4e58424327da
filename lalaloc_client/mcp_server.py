"""Server of the Model Context Protocol: tools with which assistants import plans and localise photographs.

The tools call a LaLaLoc service, with the caller's key and within its limits. Over stdio the server runs on the
caller's machine and reads files by their paths. Over streamable HTTP it reads none: files come as data URLs, and the
caller's `Authorization` header goes to the service. Then it listens on a loopback address, and bounds what callers
without a key can take: connections, their time, and the bytes of their requests.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import binascii
import dataclasses
import json
import logging
import os
import re
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

import uvicorn
from mcp.server.mcpserver import Context, Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.transport_security import TransportSecurityMiddleware, TransportSecuritySettings
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from lalaloc_client.asynchronous.client import AsyncClient
from lalaloc_client.errors import ClientError, ConnectionFailedError, ProblemError
from lalaloc_client.options import QueryOptions, ViewOptions
from lalaloc_client.requests import film_request, http_options

_INSTRUCTIONS = (
    "Finds where in a floor plan photographs were taken. Import the plan first, then localise photographs by its id. "
    "Coordinates are metres in the plan's frame, headings degrees clockwise from its +y. Believe an answer as far as "
    "its confidence says, tell the user its warnings, and if it is not sure, ask what to do next."
)
_DATA, _BASE64, _BEARER = "data:", ";base64,", "Bearer "
# Size of a request to this server, and of all requests in progress; they take six times that in memory. Values of
# JSON take thirty times their size, and a request has few besides files.
_MAX_BODY_BYTES, _MAX_RECEIVED_BYTES, _MAX_VALUES = 2**26, 2**27, 20_000
_MAX_CONNECTIONS = 64
# Timeouts for the head of a request, for its body and for its answer; solving an album takes the longest.
_HEAD_S, _BODY_S, _ANSWER_S = 15.0, 120.0, 900.0
# Web pages of other sites can make their own names resolve to a loopback address, but not these.
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_HOSTS = [f"{name}{port}" for name in _LOOPBACK for port in ("", ":*")]
_SECURITY = TransportSecuritySettings(allowed_hosts=_HOSTS, allowed_origins=[f"http://{host}" for host in _HOSTS])
_MAX_PHOTOGRAPHS, _MAX_LISTED, _MAX_PINNED = 64, 100, 500
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".insp"})
# Photographs of one upload to an album, whose bytes a service limits together, and the longest wait for its solution.
_UPLOADED_TOGETHER, _SOLVE_S = 8, 300.0
# Films are read and plans with many rooms prepared within this.
_TIMEOUT_S = 120.0

File = Annotated[str, Field(description="Path of a file on this machine, or a data URL (data:...;base64,...).")]
PlanId = Annotated[str | None, Field(description="Id of the floor plan; give this or venue_id.")]
VenueId = Annotated[str | None, Field(description="Id of a venue of several plans, instead of floorplan_id.")]
FieldOfView = Annotated[
    float | None, Field(description="Horizontal field of view in degrees. Default: from the file, or estimated.")
]
CameraHeight = Annotated[float | None, Field(description="Camera height above the floor in metres.")]


def make_server(base_url: str, api_key: str | None = None, *, reads_paths: bool) -> MCPServer[Any]:
    """Return a server whose tools call the service at an address.

    The key is for callers that send none, as over stdio. Tools read files of this machine if `reads_paths`, as is right
    only if the caller owns it.
    """
    http_options(base_url, api_key, _TIMEOUT_S)
    tools = _Tools(base_url, api_key, reads_paths=reads_paths)
    # The tools never change, so nobody needs to hold a connection to hear of it.
    server: MCPServer[Any] = MCPServer("lalaloc", instructions=_INSTRUCTIONS, subscriptions=False)
    for tool in (
        tools.import_plan,
        tools.list_plans,
        tools.localise_photograph,
        tools.localise_turn,
        tools.pin_folder,
        tools.next_step,
    ):
        server.add_tool(tool)
    return server


def make_http_server(base_url: str, host: str, port: int) -> uvicorn.Server:
    """Return a server over streamable HTTP; callers must bring keys of their own."""
    app = make_server(base_url, reads_paths=False).streamable_http_app(
        stateless_http=True, max_request_body_size=_MAX_BODY_BYTES, transport_security=_SECURITY
    )
    config = uvicorn.Config(_BoundedApp(app), host=host, port=port, http=_TimedProtocol, ws="none")
    # The protocol bounds connections; this bounds requests, which can go on when their connections are closed.
    config.limit_concurrency = _MAX_CONNECTIONS + 1
    return uvicorn.Server(config)


def main() -> int:
    """Serve on stdio, or over streamable HTTP at `/mcp`, until interrupted; return 2 for an invalid address or key."""
    parser = argparse.ArgumentParser(prog="lalaloc mcp")
    parser.add_argument("--url", required=True)
    parser.add_argument("--http", type=_address)
    arguments = parser.parse_args()
    # One line for each request is too much beside the protocol.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    try:
        if arguments.http is None:
            make_server(arguments.url, os.environ.get("LALALOC_API_KEY"), reads_paths=True).run("stdio")
            return 0
        make_http_server(arguments.url, *arguments.http).run()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _address(text: str) -> tuple[str, int]:
    host, separator, port = text.rpartition(":")
    if not (separator and host and port.isdigit() and 0 < int(port) < 2**16):
        raise argparse.ArgumentTypeError(f"'{text}' is no address; write 127.0.0.1:8765")
    if host not in _LOOPBACK:
        raise argparse.ArgumentTypeError(
            f"'{host}' is none of {', '.join(_LOOPBACK)}; to serve other machines, put a reverse proxy with TLS before "
            "this server, or connect through an SSH tunnel"
        )
    return host.strip("[]"), int(port)


class _BoundedApp:
    """App that refuses foreign hosts and origins before it reads a body, and bounds the bodies of all requests."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._security = TransportSecurityMiddleware(_SECURITY)
        self._received_bytes = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, or the start of the app."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # The library checks them, too, but after it has read the body.
        refusal = await self._security.validate_request(Request(scope))
        if refusal is None and scope["method"] != "POST":
            # Without sessions, a stream of events would stay open and empty.
            refusal = Response(status_code=405, headers={"Allow": "POST"})
        size = values = 0

        async def counted() -> Message:
            nonlocal size, values
            message = await receive()
            body = message.get("body", b"")
            size += len(body)
            self._received_bytes += len(body)
            values += sum(map(body.count, b",[{"))
            if values > _MAX_VALUES:
                raise HTTPException(413, f"the limit is {_MAX_VALUES} JSON values; send files as data URLs in base64")
            if self._received_bytes > _MAX_RECEIVED_BYTES:
                limit = f"the limit of all requests in progress is {_MAX_RECEIVED_BYTES} bytes; try again later"
                raise HTTPException(503, limit, {"Retry-After": "10"})
            return message

        try:
            await (refusal or self._app)(scope, counted, send)
        finally:
            self._received_bytes -= size


class _TimedProtocol(H11Protocol):
    """Protocol that bounds connections, and the time of each head, body and answer.

    The server itself ends connections that are idle after an answer, until the first byte of the next head.
    """

    _limit_s = 0.0
    _end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        if len(self.connections) > _MAX_CONNECTIONS:
            transport.abort()
        self._time()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._time()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._time()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._end is not None:
            self._end.cancel()

    def _time(self) -> None:
        """Begin a new timeout if the connection waits for something else than before."""
        cycle: Any = self.cycle
        limit_s = _HEAD_S
        if cycle is not None and not cycle.response_complete:
            limit_s = _BODY_S if cycle.more_body else _ANSWER_S
        if limit_s != self._limit_s:
            if self._end is not None:
                self._end.cancel()
            self._limit_s, self._end = limit_s, self.loop.call_later(limit_s, self.transport.abort)


class _Tools:
    """The tools; their docstrings and fields are what assistants read."""

    def __init__(self, base_url: str, api_key: str | None, *, reads_paths: bool) -> None:
        self._base_url, self._api_key, self._reads_paths = base_url, api_key, reads_paths

    async def import_plan(
        self,
        plan: File,
        context: Context[Any, Any],
        options: Annotated[
            dict[str, str | float | bool] | None,
            Field(
                description='Facts that the file does not state, such as {"metres_per_pixel": 0.01}, '
                '{"level": "1"}, {"page": 2} or {"unit": "cm"}.'
            ),
        ] = None,
    ) -> str:
        """Store a floor plan (DXF, IFC, SVG, PDF, PNG, JPEG, GeoJSON, native JSON, ...).

        Returns its id and rooms, and a report of what was read, assumed and left out.
        """
        document = self._file(plan)
        async with self._service(context) as service:
            stored = await service.upload_floorplan(document, options=options)
            ready = await service.wait_until_ready(stored.id)
            rooms = [{"id": room.id, "name": room.name, "type": room.type} for room in ready.rooms]
            facts = {"id": ready.id, "name": ready.name, "status": ready.status, "area_m2": ready.area_m2}
            return _text({**facts, "rooms": rooms, "warnings": ready.warnings, "report": ready.import_report})

    async def list_plans(
        self,
        context: Context[Any, Any],
        name: Annotated[str | None, Field(description="Part of the plans' names. Default: all plans.")] = None,
    ) -> str:
        """List the first hundred stored floor plans: their ids, and the numbers and times of their last revisions."""
        async with self._service(context) as service:
            plans: list[dict[str, Any]] = []
            async for plan in service.floorplans(name, page_size=_MAX_LISTED):
                stored = None if plan.updated_at is None else plan.updated_at.isoformat(timespec="seconds")
                facts = {key: getattr(plan, key) for key in ("id", "name", "status", "revision_number")}
                plans.append(facts | {"updated_at": stored})
                if len(plans) == _MAX_LISTED:
                    break
            return _text(plans)

    async def localise_photograph(
        self,
        photograph: File,
        context: Context[Any, Any],
        floorplan_id: PlanId = None,
        venue_id: VenueId = None,
        heading_deg: Annotated[
            float | None, Field(description="Heading of its centre, clockwise from the plan's +y, if known.")
        ] = None,
        hfov_deg: FieldOfView = None,
        camera_height_m: CameraHeight = None,
        picture: Annotated[bool, Field(description="Also return the answer as a picture (plans only).")] = True,
    ) -> list[str | Image]:
        """Find where in a floor plan a photograph was taken: a phone's photograph or a 360° sphere.

        Returns position, heading, room, confidence, warnings and further candidates, and the answer drawn.
        """
        content = self._file(photograph)
        options = QueryOptions(heading_deg=heading_deg, hfov_deg=hfov_deg, camera_height_m=camera_height_m)
        async with self._service(context) as service:
            found = await service.localise_query("/localise", [content], _place(floorplan_id, venue_id), options)
            answer: list[str | Image] = [found.decode()]
            if picture and floorplan_id is not None:
                answer.append(Image(data=await service.picture(floorplan_id, content, **options), format="png"))
            return answer

    async def localise_turn(
        self,
        context: Context[Any, Any],
        photographs: Annotated[
            list[File] | None,
            Field(description="Photographs of one spot in the order of the turn, overlapping by half."),
        ] = None,
        film: Annotated[
            File | None, Field(description="A film of one slow turn instead (MP4, MOV, WebM, Matroska).")
        ] = None,
        floorplan_id: PlanId = None,
        venue_id: VenueId = None,
        hfov_deg: FieldOfView = None,
        camera_height_m: CameraHeight = None,
    ) -> str:
        """Find where someone stood who turned around once: far surer than a single photograph."""
        if (photographs is None) == (film is None):
            raise ToolError("give either photographs or film")
        contents = [self._file(photograph) for photograph in photographs or []]
        if film is None and not 2 <= len(contents) <= _MAX_PHOTOGRAPHS:
            raise ToolError(f"{len(contents)} photographs are given; a turn has 2 to {_MAX_PHOTOGRAPHS}")
        path, options = "/localise/sequence", ViewOptions(hfov_deg=hfov_deg)
        values = {**_place(floorplan_id, venue_id), "motion": "turn", "camera_height_m": camera_height_m}
        async with self._service(context) as service:
            if film is None:
                found = await service.localise_query(path, contents, values, options)
            else:
                found = await service.query(film_request, path, self._file(film), values, options)
            return found.decode()

    async def pin_folder(
        self,
        context: Context[Any, Any],
        folder: Annotated[str | None, Field(description="Path of a folder of photographs on this machine.")] = None,
        photographs: Annotated[list[File] | None, Field(description="The photographs instead, each as a file.")] = None,
        floorplan_id: PlanId = None,
        venue_id: VenueId = None,
        hfov_deg: FieldOfView = None,
        camera_height_m: CameraHeight = None,
    ) -> list[str | Image]:
        """Pin up to 500 photographs of one visit to a plan together: the room of each, its place and an arrow.

        Returns the state of each (sure, uncertain, set_aside) with reasons and suggestions, the photographs that were
        refused, the id of the stored album, and for one plan a drawing of it (SVG).
        """
        files = self._folder(folder, photographs)
        _place(floorplan_id, venue_id)
        view = ViewOptions(hfov_deg=hfov_deg)
        async with self._service(context) as service:
            album = await service.create_album(floorplan_id, venue_id=venue_id, camera_height_m=camera_height_m, **view)
            refused = [
                {"photograph": line.name or first + line.index + 1, "problem": line.problem}
                for first in range(0, len(files), _UPLOADED_TOGETHER)
                async for line in service.add_to_album(album.id, files[first : first + _UPLOADED_TOGETHER])
                if line.problem is not None
            ]
            solved = await service.wait_until_solved(album.id, _SOLVE_S)
            pins = [
                {"photograph": row.name or row.number, **dataclasses.asdict(row.pin)}
                async for row in service.album_photographs(album.id)
                if row.pin is not None
            ]
            told = {"album_id": album.id, "solution": solved.solution, "pins": pins, "refused": refused}
            answer: list[str | Image] = [_text(told)]
            if floorplan_id is not None and pins:
                answer.append((await service.album_file(album.id, "svg")).decode())
            return answer

    def _folder(self, folder: str | None, photographs: list[str] | None) -> list[bytes | Path]:
        """Return the photographs of a folder by name, or those that are given."""
        if (folder is None) == (photographs is None):
            raise ToolError("give either folder or photographs")
        if folder is None:
            files = [self._file(photograph) for photograph in photographs or []]
        else:
            if not self._reads_paths:
                raise ToolError("this server reads no folders of its machine; send the photographs as data URLs")
            path = Path(os.path.expanduser(folder))
            if not path.is_dir():
                raise ToolError(f"there is no folder '{folder}'; give the full path")
            found = [entry for entry in path.iterdir() if entry.suffix.lower() in _SUFFIXES and entry.name[0] != "."]
            # As on the command line, whose numbers the photographs then have.
            files = sorted(found, key=lambda entry: re.sub(r"\d+", lambda digits: digits[0].zfill(20), entry.name))
        if not 1 <= len(files) <= _MAX_PINNED:
            raise ToolError(f"{len(files)} photographs are given; an album has 1 to {_MAX_PINNED}")
        return [*files]

    async def next_step(
        self,
        photograph: File,
        context: Context[Any, Any],
        floorplan_id: PlanId = None,
        venue_id: VenueId = None,
        hfov_deg: FieldOfView = None,
    ) -> str:
        """Say what to do next to make an unsure answer sure, such as a turn, a step through a door, or a heading."""
        content = self._file(photograph)
        async with self._service(context) as service:
            options = QueryOptions(hfov_deg=hfov_deg)
            found = await service.localise_query("/localise", [content], _place(floorplan_id, venue_id), options)
            answer = json.loads(found)
            view = answer.get("view") or {}
            said = {name: view[name] for name in ("advice", "next_step") if view.get(name) is not None}
            return _text({"confidence": answer.get("confidence"), **said, "warnings": answer.get("warnings", [])})

    @asynccontextmanager
    async def _service(self, context: Context[Any, Any]) -> AsyncIterator[AsyncClient]:
        """Yield a client with the caller's key; errors of the service become errors of the tool, with the remedy."""
        sent = "" if context.headers is None else context.headers.get("authorization", "")
        key = sent.removeprefix(_BEARER) if sent.startswith(_BEARER) else self._api_key
        try:
            async with AsyncClient(self._base_url, api_key=key, timeout_s=_TIMEOUT_S) as service:
                yield service
        except ProblemError as error:
            faults = "".join(f"; {name} {message}" for name, message in error.faults)
            raise ToolError(f"{error.detail}{faults}") from error
        except ConnectionFailedError as error:
            raise ToolError(f"{error}; does the service at {self._base_url} run?") from error
        except (ClientError, OSError, ValueError) as error:
            raise ToolError(str(error)) from error

    def _file(self, text: str) -> bytes | Path:
        """Return the content of a data URL, or the path of a file."""
        if text.startswith(_DATA):
            _, separator, encoded = text.partition(_BASE64)
            if not separator:
                raise ToolError("the data URL is not in base64; write data:image/jpeg;base64,...")
            try:
                return base64.b64decode(encoded, validate=True)
            except binascii.Error as error:
                raise ToolError("the data URL is damaged: it is not valid base64") from error
        if not self._reads_paths:
            raise ToolError("this server reads no files of its machine; send the file as a data URL")
        path = Path(os.path.expanduser(text))
        if not path.is_file():
            raise ToolError(f"there is no file '{text}'; give the full path")
        return path


def _place(floorplan_id: str | None, venue_id: str | None) -> dict[str, str | None]:
    if (floorplan_id is None) == (venue_id is None):
        raise ToolError("give either floorplan_id or venue_id; list_plans names the stored plans")
    return {"floorplan_id": floorplan_id, "venue_id": venue_id}


def _text(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


if __name__ == "__main__":
    sys.exit(main())
