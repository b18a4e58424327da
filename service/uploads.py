"""Reading request bodies: bounded in bytes while they stream in, bounded in time, and with every part accounted for."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from typing import TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError
from python_multipart.exceptions import FormParserError
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect

from service.errors import (
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)

JSON = "application/json"
MULTIPART = "multipart/form-data"
# Boundaries and part headers come on top of the file that the limit is meant for.
_ENVELOPE_BYTES = 16 * 1024
_MAX_PARTS = 20
_MAX_FIELD_BYTES = 4096

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class UploadLimits:
    """Bytes that the uploaded file may have, and seconds that the whole upload may take."""

    max_bytes: int
    deadline_s: float


class Slots:
    """How many uploads, and the work that follows them, may go on at the same time; for one event loop."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.taken = 0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Hold a slot.

        Raises:
            OverloadedError: all are taken.
        """
        if self.taken >= self._limit:
            raise OverloadedError(self._limit)
        self.taken += 1
        try:
            yield
        finally:
            self.taken -= 1


@dataclass(frozen=True)
class Parts:
    """A multipart body: plain fields, and the bytes of files."""

    fields: dict[str, str]
    files: dict[str, bytes]


def media_type(request: Request, accepted: tuple[str, ...]) -> str:
    """The body's media type without parameters.

    Raises:
        UnsupportedMediaError: it is none of those accepted.
    """
    stated = request.headers.get("content-type", "")
    media = stated.partition(";")[0].strip().lower()
    if media not in accepted:
        raise UnsupportedMediaError(stated, accepted)
    return media


async def read_body(request: Request, limits: UploadLimits) -> bytes:
    """The whole body.

    Raises:
        UploadTooLargeError, UploadTimeoutError: see the limits.
    """
    _check_stated_size(request, limits.max_bytes)
    async with _in_time(limits):
        return b"".join([chunk async for chunk in _counted(request, limits.max_bytes)])


async def read_parts(request: Request, limits: UploadLimits, *, files: set[str], fields: set[str]) -> Parts:
    """A multipart body that must have every one of `files`, and no parts other than `files` and `fields`.

    Raises:
        UploadTooLargeError, UploadTimeoutError: see the limits.
        MalformedRequestError: not valid multipart.
        InvalidRequestError: a part is missing, unknown, given twice, or a field where a file belongs.
    """
    limit = limits.max_bytes + _ENVELOPE_BYTES
    _check_stated_size(request, limit)
    parser = MultiPartParser(
        request.headers,
        _counted(request, limit),
        max_files=_MAX_PARTS,
        max_fields=_MAX_PARTS,
        max_part_size=_MAX_FIELD_BYTES,
    )
    try:
        async with _in_time(limits):
            form = await parser.parse()
    except MultiPartException as error:
        raise MalformedRequestError(f"not valid {MULTIPART}: {error.message}") from error
    except FormParserError as error:
        raise MalformedRequestError(f"not valid {MULTIPART}: {error}") from error
    try:
        return await _sort(form.multi_items(), limits.max_bytes, files, fields)
    finally:
        await form.close()


def validate_fields(model: type[Model], fields: Mapping[str, str]) -> Model:
    """Fields of a form as a model; empty ones count as left out.

    Raises:
        InvalidRequestError: names every field at fault, its value and the limit.
    """
    try:
        return model.model_validate({name: value for name, value in fields.items() if value.strip()})
    except ValidationError as error:
        raise InvalidRequestError([describe_fault(fault) for fault in error.errors()]) from error


def describe_fault(fault: Mapping[str, object]) -> tuple[str, str]:
    """(field, message) of one of pydantic's faults; the message states the value."""
    location = fault.get("loc")
    parts = [str(part) for part in location] if isinstance(location, tuple) else []
    if parts and parts[0] in ("body", "query", "path"):
        parts = parts[1:]
    message = str(fault.get("msg", "invalid"))
    value = fault.get("input")
    if fault.get("type") == "missing":
        message = "is missing"
    elif isinstance(value, str | int | float):
        message = f"is '{str(value)[:100]}': {message[:1].lower()}{message[1:]}"
    return ".".join(parts) or "body", message


async def _sort(items: list[tuple[str, UploadFile | str]], max_bytes: int, files: set[str], fields: set[str]) -> Parts:
    faults: list[tuple[str, str]] = []
    found = Parts({}, {})
    for name, value in items:
        shown = name[:50]
        if name not in files | fields:
            known = ", ".join(sorted(files | fields))
            faults.append((shown, f"unknown part, known are {known}"))
        elif name in found.fields or name in found.files:
            faults.append((shown, "given more than once"))
        elif name in fields:
            if isinstance(value, UploadFile):
                faults.append((shown, "must be a plain field, not a file"))
            else:
                found.fields[name] = value
        elif isinstance(value, UploadFile):
            content = await value.read()
            if len(content) > max_bytes:
                raise UploadTooLargeError(max_bytes, len(content))
            found.files[name] = content
        else:
            faults.append((shown, "must be a file (a part with a file name)"))
    given = {name for name, _ in items}
    faults.extend((name, "is missing") for name in sorted(files - given))
    if faults:
        raise InvalidRequestError(faults)
    return found


def _check_stated_size(request: Request, limit: int) -> None:
    stated = request.headers.get("content-length", "")
    if stated.isdecimal() and int(stated) > limit:
        raise UploadTooLargeError(limit, int(stated))


async def _counted(request: Request, limit: int) -> AsyncGenerator[bytes, None]:
    received = 0
    try:
        async for chunk in request.stream():
            received += len(chunk)
            if received > limit:
                raise UploadTooLargeError(limit)
            yield chunk
    except ClientDisconnect as error:
        raise MalformedRequestError("the connection was closed before the whole body arrived") from error


@asynccontextmanager
async def _in_time(limits: UploadLimits) -> AsyncGenerator[None, None]:
    try:
        async with asyncio.timeout(limits.deadline_s):
            yield
    except TimeoutError as error:
        raise UploadTimeoutError(limits.deadline_s) from error
