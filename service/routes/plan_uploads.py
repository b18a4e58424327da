"""Plan uploads: a plan file, alone or in a form with options, and the answer, in JSON or in lines with its steps."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from fastapi import Response
from pydantic import BaseModel

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.file_kinds import describe_file
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import (
    ImportOptions,
    ImportStep,
    Level,
    OnStep,
    begins_with_plans,
    building_name,
    detect_format,
    detect_media_type,
    import_if_native,
    is_json,
)
from service.errors import InvalidRequestError
from service.grids.embedding import check_size
from service.http.idempotent_request import REPLAYED, IdempotentRequest
from service.http.problems import problem_in_line
from service.http.representations import NDJSON, LinesResponse, preferred
from service.http.uploads import JSON, MULTIPART, Parts, UploadLimits, media_type, read_body, read_parts
from service.plan_documents import LARGE, PlanDocument, Rendition
from service.plan_files.convert_worker import report_of
from service.routes.dependencies import ApiCall
from service.routes.descriptions import BINARY, json_body
from service.schemas.native_plan import FloorPlanDocument
from service.schemas.plan_import import ImportForm, LevelsForm
from service.storage.records import ComputedGrid, NewPlan, Original
from service.uploaded_file import UploadedFile

P = ParamSpec("P")
T = TypeVar("T")
_FILE = "file"
# Levels of a venue, as in requests.
_MAX_LEVEL = 1000.0
# Media types that clients send; the actual format is detected from the content.
_FILES = (
    JSON, "application/geo+json", "application/zip", "application/pdf", "application/xml", "image/svg+xml",
    "image/png", "image/jpeg", "image/vnd.dxf", "application/dxf", "application/x-step", "application/octet-stream",
)  # fmt: skip
_PICTURES = ("image/png", "image/jpeg")
_BYTES = {"schema": BINARY}


def _form_schema(form: type[BaseModel]) -> dict[str, Any]:
    schema = form.model_json_schema()
    schema["properties"][_FILE] = BINARY | {
        "description": "GeoJSON, an IMDF archive, OpenStreetMap (XML or Overpass JSON), a RoomPlan scan, a Valetudo "
        "map, SVG, DXF, IFC (also zipped), PDF, PNG, JPEG, or JSON in the native format (FloorPlanDocument). The "
        "format is detected from the content."
    }
    schema["required"] = [_FILE]
    return schema


# Request body of both operations that take a plan.
UPLOAD_BODY = json_body(
    FloorPlanDocument, **{MULTIPART: {"schema": _form_schema(ImportForm)}}, **dict.fromkeys(_FILES[1:], _BYTES)
)
# Form of an operation that takes a file with all its levels.
LEVELS_FORM: dict[str, Any] = {"schema": _form_schema(LevelsForm)}


@dataclass(frozen=True)
class PlanFile:
    """Plan of an uploaded file."""

    plan: FloorPlan
    report: str
    media_type: str
    level: Level | None = None
    document: PlanDocument | None = None
    description: Rendition | None = None


@dataclass(frozen=True)
class PlanUpload:
    """Uploaded file with its options."""

    file: UploadedFile
    options: ImportOptions
    parts: Parts
    is_native: bool

    async def on_thread(
        self, call: ApiCall, work: Callable[P, Response], *args: P.args, **kwargs: P.kwargs
    ) -> Response:
        """Run work on the file on a thread; files that wait for a worker have threads of their own."""
        threads = call.runtime.uploads if self.is_native else call.runtime.file_uploads
        return await threads.run(call.client, work, *args, **kwargs)


async def read_upload(call: ApiCall, form: type[BaseModel] = ImportForm) -> PlanUpload:
    """Read the file in a request, with its options, the fields of a form."""
    limits = UploadLimits.of(call.settings, "max_plan_bytes")
    if media_type(call.request, (MULTIPART, *_FILES)) != MULTIPART:
        parts = Parts({}, {_FILE: await read_body(call.request, limits)})
    else:
        known = set(form.model_fields)
        parts = await read_parts(call.request, limits, files={_FILE}, fields=known, check=_faults)
    file = parts.files[_FILE]
    return PlanUpload(file, ImportOptions.from_text(parts.fields), parts, _seems_native(file))


def _seems_native(file: UploadedFile) -> bool:
    """Return whether a file looks like a small native plan, which needs no worker."""
    if len(file) > LARGE:
        return False
    content = file.read()
    return is_json(content) and not begins_with_plans(content) and describe_file(content) is None


def _faults(fields: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return (name, message) of invalid options, and of options that contradict each other."""
    faults = []
    for name, text in fields.items():
        try:
            ImportOptions.from_text({name: text})
        except InvalidFloorPlanError as error:
            faults.append((name, error.reason.removeprefix(f"{name} ")))
    if not faults:
        try:
            ImportOptions.from_text(fields)
        except InvalidFloorPlanError as error:
            faults.append(("scale", error.reason))
    return faults


def _plan_files(
    uploaded: PlanUpload, content: bytes, call: ApiCall, name: str | None, on_step: OnStep | None, *, every_level: bool
) -> list[PlanFile]:
    """Return the only plan of an uploaded file, or those of its levels, lowest first.

    `name` is for plans that have none, and for those of several levels, unless the options have one. Single native
    plans of up to 256 KiB are parsed here, in milliseconds. Worker processes read, validate and describe all others:
    large or many plans would take the interpreter from other requests, and other formats can crash their reader.
    """
    runtime, limits = call.runtime, call.settings.plans.import_limits
    if not content.strip():
        raise InvalidFloorPlanError("the body is empty; send a plan file")
    if uploaded.is_native:
        with runtime.cores.hold(call.client):
            imported = import_if_native(content, uploaded.options, limits, building=name)
            if imported is not None:
                media_type = detect_media_type(content, "native")
                return [PlanFile(imported.plan(limits.plan), report_of(imported), media_type)]
    elif not is_json(content):
        # Reject unsupported formats before they take a worker.
        detect_format(content, limits)
    files: list[PlanFile] = []
    for level in runtime.converter.read(
        content, uploaded.options, call.client, every_level=every_level, building=name, on_step=on_step
    ):
        with runtime.cores.hold(call.client):
            plan = level.plan.plan()
        files.append(PlanFile(plan, level.report, level.media_type, level.level, level.document, level.description))
    return files


def prepare_plan(uploaded: PlanUpload, call: ApiCall, on_step: OnStep | None = None) -> tuple[NewPlan, PlanFile]:
    """Return the plan in an uploaded file, with its pose grid if that is computed at once, and as it was read. Blocks.

    `on_step` is as for `Converter.read`.
    """
    content = uploaded.file.read()
    (file,) = _plan_files(uploaded, content, call, building_name(uploaded.file.name), on_step, every_level=False)
    check_size(file.plan, call.settings)
    original = Original(content, file.media_type, file.report)
    return _new_plan(file, original, call.runtime.grids.prepare(file.plan, call.client), 0.0, call), file


def prepare_levels(uploaded: PlanUpload, call: ApiCall, name: str, on_step: OnStep | None = None) -> list[NewPlan]:
    """Return a plan of every level of a file with rooms, with the pose grids that are computed at once. Blocks.

    `on_step` is as for `Converter.read`.
    """
    content = uploaded.file.read()
    files = _plan_files(uploaded, content, call, name, on_step, every_level=True)
    limit = call.settings.plans.max_venue_plans
    if len(files) > limit:
        fault = f"has {len(files)} levels; the limit is {limit} floor plans (LALALOC_MAX_VENUE_PLANS)"
        raise InvalidRequestError([("file", fault)])
    for file in files:
        check_size(file.plan, call.settings, None if file.level is None else file.level.name)
    grids = call.runtime.grids.prepare_all([file.plan for file in files], call.client)
    # Every storey of a picture keeps it, to be corrected over it.
    originals = [
        _original(file, content if len(files) == 1 or file.media_type in _PICTURES else None) for file in files
    ]
    return [_new_plan(*values, call) for values in zip(files, originals, grids, _level_numbers(files), strict=True)]


def _new_plan(file: PlanFile, original: Original, grid: ComputedGrid | None, level: float, call: ApiCall) -> NewPlan:
    later_bytes = call.runtime.grids.expected_bytes(file.plan) if grid is None else 0
    return NewPlan(file.plan, original, file.document, grid, later_bytes, level)


def _original(file: PlanFile, content: bytes | None) -> Original:
    """Return the file that is kept for a plan: a level in the native format where the uploaded file has several."""
    if content is not None:
        return Original(content, file.media_type, file.report)
    document = file.document or PlanDocument.from_plan(file.plan)
    return Original(document.document.encode(), JSON, file.report)


def _level_numbers(files: Sequence[PlanFile]) -> list[float]:
    """Return the levels' numbers; their order if the file gives a level none."""
    numbers = [0.0 if file.level is None else file.level.number for file in files]
    known = [number for number in numbers if number is not None and abs(number) <= _MAX_LEVEL]
    return known if len(known) == len(files) else [float(index) for index in range(len(files))]


# A step that goes on is sent again after this time (s): proxies and clients end connections that stand still.
_REPEAT_S = 10.0
_WAITING = ImportStep("waiting for a worker")

# Stores an import under a token, with a function that is told its steps (`on_step`), and returns the answer.
Store = Callable[..., Response]


async def answer_import(call: ApiCall, idempotent: IdempotentRequest, uploaded: PlanUpload, store: Store) -> Response:
    """Answer an import in JSON, or in lines with its steps if the request prefers them.

    Refusals are the last line then: the answer has begun, with status 200.
    """

    # On a thread as one call from claim to answer, so that a disconnect does not interrupt it.
    async def run(work: Callable[[str], Response]) -> Response:
        return await uploaded.on_thread(call, idempotent.run, uploaded.parts, work)

    if preferred(call.request, (JSON, NDJSON)) == JSON:
        return await run(partial(store, on_step=None))
    return LinesResponse(_lines(call, run, store), call.settings.requests.request_deadline_s)


async def _lines(
    call: ApiCall, run: Callable[[Callable[[str], Response]], Coroutine[Any, Any, Response]], store: Store
) -> AsyncGenerator[str]:
    latest = _LatestStep(asyncio.get_running_loop())
    answer = run(partial(store, on_step=latest.put))
    # A task is not part of the request's own steps.
    task = asyncio.ensure_future(call.runtime.admission.cpu_accounts.charged_steps(call.client, answer))
    task.add_done_callback(lambda _task: latest.wake())
    step = _WAITING
    try:
        while not task.done():
            yield _line({"step": step.step, "done": step.done, "total": step.total})
            step = await latest.next(_REPEAT_S)
        try:
            yield _answer_line(task.result())
        except Exception as error:
            problem, retry_after_s = problem_in_line(call.request, error)
            document = problem.model_dump(mode="json", exclude_none=True)
            yield _line({"status": problem.status, "problem": document, "retry_after_s": retry_after_s})
    finally:
        # A call that has begun is finished on its thread, as for an answer in JSON.
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


class _LatestStep:
    """Latest step of an import; a client that reads slowly misses some, so they take no memory."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._step = loop, _WAITING
        self._changed = asyncio.Event()

    def put(self, step: ImportStep) -> None:
        """Set the step; called on any thread."""
        self._step = step
        # The loop can be closed already.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self.wake)

    def wake(self) -> None:
        """End the wait of `next`."""
        self._changed.set()

    async def next(self, limit_s: float) -> ImportStep:
        """Wait for a change, at most `limit_s`; return the latest step."""
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                await self._changed.wait()
        self._changed.clear()
        return self._step


def _answer_line(response: Response) -> str:
    """Return the line of an answer, also of a kept one; its content is JSON."""
    is_problem = response.status_code >= 400
    values: dict[str, Any] = {"status": response.status_code}
    if not is_problem:
        values["etag"] = response.headers.get("ETag")
    if REPLAYED in response.headers:
        values["replayed"] = True
    # Not parsed: plans can have megabytes. A text of JSON has no line breaks, only the space between its values.
    content = bytes(response.body).decode().replace("\n", " ")
    return f'{_line(values)[:-1]}, "{"problem" if is_problem else "answer"}": {content}}}'


def _line(values: dict[str, Any]) -> str:
    # In ASCII: steps and details quote the file, which is not always encodable as UTF-8.
    return json.dumps({name: value for name, value in values.items() if value is not None})
