"""Reading request bodies, with limits on size and time, and checks of fields; `multipart.py` reads their parts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from tempfile import SpooledTemporaryFile, TemporaryFile
from time import monotonic
from typing import Literal, Self, TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError
from starlette.datastructures import UploadFile
from starlette.requests import ClientDisconnect

from service import errors
from service.http.fields import describe_fault
from service.http.request_end import on_request_end
from service.settings import Settings
from service.uploaded_file import UploadedFile

JSON = "application/json"
GEOJSON = "application/geo+json"
GEOPOSE = "application/geopose+json"
MULTIPART = "multipart/form-data"

# Settings that limit an upload.
Settable = Literal["max_plan_bytes", "max_photograph_bytes", "max_sequence_bytes", "max_film_bytes", "max_venue_bytes"]
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class UploadLimits:
    """Limits of an upload.

    Attributes:
        max_bytes: maximum size of the file.
        name: setting of `max_bytes`.
        deadline_s: timeout of the whole upload.
        idle_s: timeout for the next bytes; also the tolerated delay behind `bytes_per_s`.
        bytes_per_s: minimum rate.
        memory_bytes: size beyond which a file is written to disk.
    """

    max_bytes: int
    name: str
    deadline_s: float
    idle_s: float
    bytes_per_s: float
    memory_bytes: int

    @classmethod
    def of(cls, settings: Settings, name: Settable) -> Self:
        """Return the limits of one kind of upload."""
        return cls(
            max_bytes=settings.value(name),
            name=name,
            deadline_s=settings.uploads.deadline_s,
            idle_s=settings.uploads.idle_s,
            bytes_per_s=settings.uploads.bytes_per_s,
            memory_bytes=settings.uploads.memory_bytes,
        )


def media_type(request: Request, accepted: tuple[str, ...]) -> str:
    """Return the body's media type without parameters."""
    for encoding in request.headers.getlist("content-encoding"):
        if encoding.strip().lower() not in ("", "identity"):
            raise errors.UnsupportedEncodingError(encoding)
    stated = request.headers.get("content-type", "")
    media = stated.partition(";")[0].strip().lower()
    if media not in accepted:
        raise errors.UnsupportedMediaError(stated, accepted)
    return media


async def read_body(request: Request, limits: UploadLimits) -> UploadedFile:
    """Read the whole body."""
    # Closed by `kept_file`.
    body = UploadFile(SpooledTemporaryFile(memory_bytes_of(limits)), size=0)  # noqa: SIM115  # pyright: ignore[reportArgumentType]
    with spooling(limits):
        async with in_time(limits):
            async for chunk in counted_chunks(request, limits):
                await body.write(chunk)
    return kept_file(request, body)


def validate_fields(model: type[Model], fields: Mapping[str, str], context: Mapping[str, object]) -> Model:
    """Return the fields of a form as a model; empty fields count as left out.

    Raises:
        InvalidRequestError: names every faulty field, its value and the limit.
    """
    try:
        return model.model_validate({name: value for name, value in fields.items() if value.strip()}, context=context)
    except ValidationError as error:
        raise errors.InvalidRequestError([describe_fault(fault) for fault in error.errors()]) from error


def faults_of(
    model: type[BaseModel], fields: Mapping[str, str], context: Mapping[str, object]
) -> list[tuple[str, str]]:
    """Return the faults for which `validate_fields` would raise."""
    try:
        validate_fields(model, fields, context)
    except errors.InvalidRequestError as error:
        return error.faults
    return []


def kept_file(request: Request, upload: UploadFile) -> UploadedFile:
    """Return an uploaded file, which is deleted at the end of the request."""
    file = UploadedFile(upload.file, upload.filename)
    on_request_end(request.scope, file.close)
    return file


def memory_bytes_of(limits: UploadLimits) -> int:
    """Return the size beyond which a file is written to disk; 0, never, without a usable folder for it."""
    try:
        with TemporaryFile():
            return limits.memory_bytes
    except OSError:
        return 0


@contextmanager
def spooling(limits: UploadLimits) -> Iterator[None]:
    """Turn errors of temporary files into the error of a full disk."""
    try:
        yield
    except TimeoutError:
        raise
    except OSError as error:
        raise errors.SpoolFullError(limits.memory_bytes) from error


async def counted_chunks(
    request: Request, limits: UploadLimits, *, envelope_bytes: int = 0
) -> AsyncGenerator[bytes, None]:
    """Yield the body as it arrives, within the limits of size and rate."""
    max_bytes = limits.max_bytes + envelope_bytes
    stated = request.headers.get("content-length", "")
    # Refuse before reading if the stated length is too large.
    if stated.isdecimal() and int(stated) > max_bytes:
        raise errors.UploadTooLargeError(limits.name, limits.max_bytes, int(stated))
    received, begin = 0, monotonic()
    chunks = request.stream()
    while True:
        ahead_s = received / limits.bytes_per_s - (monotonic() - begin)
        chunk = await _next_chunk(chunks, min(limits.idle_s, limits.idle_s + ahead_s), limits)
        if chunk is None:
            return
        received += len(chunk)
        if received > max_bytes:
            raise errors.UploadTooLargeError(limits.name, limits.max_bytes)
        yield chunk


async def _next_chunk(chunks: AsyncGenerator[bytes, None], patience_s: float, limits: UploadLimits) -> bytes | None:
    """Return the next bytes of a body, None at its end."""
    try:
        async with asyncio.timeout(max(patience_s, 0.0)):
            return await anext(chunks, None)
    except TimeoutError as error:
        raise errors.UploadTimeoutError(
            f"the upload stopped for {limits.idle_s:g} s (upload_idle_s), or lagged that far behind "
            f"{limits.bytes_per_s:g} bytes/s (upload_bytes_per_s)"
        ) from error
    except ClientDisconnect as error:
        raise errors.MalformedRequestError("the connection was closed before the whole body arrived") from error


@asynccontextmanager
async def in_time(limits: UploadLimits) -> AsyncGenerator[None, None]:
    """Turn the timeout of a whole upload into its error."""
    try:
        async with asyncio.timeout(limits.deadline_s):
            yield
    except TimeoutError as error:
        raise errors.UploadTimeoutError(
            f"the upload took longer than {limits.deadline_s:g} s (upload_deadline_s)"
        ) from error
