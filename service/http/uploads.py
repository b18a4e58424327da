"""Reader of request bodies: as a whole, or in parts, within limits of size, time and rate.

Every byte comes from `_Body.chunks`, whoever asks for it. Large files are written to disk.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from tempfile import SpooledTemporaryFile, TemporaryFile
from time import monotonic
from types import MappingProxyType
from typing import Literal, NamedTuple, Self

from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect
from starlette.types import Scope

from service import errors
from service.settings import Settings
from service.uploaded_file import UploadedFile

JSON = "application/json"
GEOJSON = "application/geo+json"
GEOPOSE = "application/geopose+json"
MULTIPART = "multipart/form-data"

_SCOPE_KEY = "lalaloc.request_end"
# Boundaries and part headers, which do not count towards the limit.
_ENVELOPE_BYTES = 64 * 1024
_MAX_PARTS = 20
# The motions between 100 photographs have about 16 kB.
_MAX_FIELD_BYTES = 32 * 1024
# Beginnings of the parser's messages about more files than it may read, and about a part without a file name that
# exceeds `_MAX_FIELD_BYTES`.
_TOO_MANY_FILES, _TOO_LARGE_PART = "Too many files", "Part exceeded maximum size"
_NO_FILE = "must be a file (a part with a file name)"
_LARGE_FIELD = f"has more than {_MAX_FIELD_BYTES} bytes, the limit of a field"
_UTF_8 = b"utf-8"

# Settings that limit an upload.
Settable = Literal["max_plan_bytes", "max_photograph_bytes", "max_sequence_bytes", "max_film_bytes", "max_venue_bytes"]
# Returns (name, message) of invalid values of fields.
Check = Callable[[Mapping[str, str]], list[tuple[str, str]]]


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


@contextmanager
def ending_request(scope: Scope) -> Iterator[None]:
    """Call the functions of `on_request_end` at the end of the block."""
    with ExitStack() as stack:
        scope[_SCOPE_KEY] = stack
        yield


def on_request_end(scope: Scope, call: Callable[[], None]) -> None:
    """Call a function when the answer is sent, or the request has failed."""
    stack: ExitStack | None = scope.get(_SCOPE_KEY)
    if stack is not None:
        stack.callback(call)


async def read_body(request: Request, limits: UploadLimits) -> UploadedFile:
    """Read the whole body."""
    body = _Body(request, limits)
    # Closed by `keep`.
    content = UploadFile(SpooledTemporaryFile(body.memory_bytes), size=0)  # noqa: SIM115  # pyright: ignore[reportArgumentType]
    async with body.bounded():
        async for chunk in body.chunks():
            await content.write(chunk)
    return body.keep(content)


class Repeats(NamedTuple):
    """Smallest and largest number of files of one name, and the setting of the largest, if it can be set."""

    least: int
    most: int
    setting: str = ""

    def fault(self, count: str) -> str:
        """Return the message about a wrong number of files."""
        if not self.setting:
            return f"is given {count} times; send one"
        return f"is given {count} times, {self.least} to {self.most} are needed (LALALOC_{self.setting.upper()})"


@dataclass(frozen=True)
class Parts:
    """Multipart body: fields and files; repeated files are `name[0]`, `name[1]`..."""

    fields: dict[str, str]
    files: dict[str, UploadedFile]

    def named(self, name: str) -> list[UploadedFile]:
        """Return the files of a name, in order: the single one, or those that were repeated."""
        return [file for key, file in self.files.items() if key.partition("[")[0] == name]


async def read_parts(
    request: Request,
    limits: UploadLimits,
    *,
    files: set[str],
    fields: set[str],
    check: Check = lambda _fields: [],
    repeated: Mapping[str, Repeats] = MappingProxyType({}),
    aliases: Mapping[str, str] = MappingProxyType({}),
    substitutes: Mapping[str, str] = MappingProxyType({}),
) -> Parts:
    """Read a multipart body.

    Args:
        request: the request.
        limits: limits of the upload.
        files: names of required files.
        fields: names of optional fields.
        check: returns (field, message) for invalid values of fields.
        repeated: files that can be repeated.
        aliases: other names of files, and the names under which they are returned.
        substitutes: other kinds of files, and the names of the files that they can be sent instead of.
    """
    stated = request.headers.get("content-type", "")
    options = parse_options_header(stated)[1]
    if options.get(b"charset", _UTF_8).lower() != _UTF_8:
        raise errors.UnsupportedMediaError(stated, (f"{MULTIPART}; charset=utf-8",))
    expected = _Expected.of(files, fields, repeated, substitutes)
    # One more than allowed, so that the error states the limit.
    max_files = max([_MAX_PARTS, *(repeats.most + 1 for repeats in repeated.values())])
    body = _Body(request, limits, _ENVELOPE_BYTES)
    chunks = _within_parts(body.chunks(), options.get(b"boundary", b""), max_files + _MAX_PARTS)
    parser = MultiPartParser(
        request.headers, chunks, max_files=max_files, max_fields=_MAX_PARTS, max_part_size=_MAX_FIELD_BYTES
    )
    parser.spool_max_size = body.memory_bytes
    try:
        async with body.bounded():
            form = await parser.parse()
    except MultiPartException as error:
        # The part that the parser reads; the error does not name it.
        name = parser._current_part.field_name[:50]
        raise expected.refusal(error.message, name, is_file=aliases.get(name, name) in expected.files) from error
    items = [
        (aliases.get(name, name), value if isinstance(value, str) else body.keep(value))
        for name, value in form.multi_items()
    ]
    return expected.sort(items, limits, check)


class _Body:
    """Body of a request.

    Attributes:
        memory_bytes: size beyond which a file is written to disk; 0, never, without a usable folder for it.
    """

    def __init__(self, request: Request, limits: UploadLimits, envelope_bytes: int = 0) -> None:
        self._request, self._limits = request, limits
        self._max_bytes = limits.max_bytes + envelope_bytes
        try:
            with TemporaryFile():
                self.memory_bytes = limits.memory_bytes
        except OSError:
            self.memory_bytes = 0

    @asynccontextmanager
    async def bounded(self) -> AsyncGenerator[None]:
        """Bound the time of the block, which reads the body, and name the reason if the disk is full."""
        try:
            async with asyncio.timeout(self._limits.deadline_s):
                yield
        except TimeoutError as error:
            raise errors.UploadTimeoutError(
                f"the upload took longer than {self._limits.deadline_s:g} s (upload_deadline_s)"
            ) from error
        except OSError as error:
            raise errors.SpoolFullError(self._limits.memory_bytes) from error

    async def chunks(self) -> AsyncGenerator[bytes]:
        """Yield the body as it arrives, within the limits of size and rate."""
        limits = self._limits
        stated = self._request.headers.get("content-length", "")
        # Refuse before reading if the stated length is too large.
        if stated.isdecimal() and int(stated) > self._max_bytes:
            raise errors.UploadTooLargeError(limits.name, limits.max_bytes, int(stated))
        received, begin, stream = 0, monotonic(), self._request.stream()
        while True:
            ahead_s = received / limits.bytes_per_s - (monotonic() - begin)
            try:
                async with asyncio.timeout(max(limits.idle_s + min(ahead_s, 0.0), 0.0)):
                    chunk = await anext(stream, None)
            except TimeoutError as error:
                raise errors.UploadTimeoutError(
                    f"the upload stopped for {limits.idle_s:g} s (upload_idle_s), or lagged that far behind "
                    f"{limits.bytes_per_s:g} bytes/s (upload_bytes_per_s)"
                ) from error
            except ClientDisconnect as error:
                raise errors.MalformedRequestError("the connection was closed before the whole body arrived") from error
            if chunk is None:
                return
            received += len(chunk)
            if received > self._max_bytes:
                raise errors.UploadTooLargeError(limits.name, limits.max_bytes)
            yield chunk

    def keep(self, upload: UploadFile) -> UploadedFile:
        """Return an uploaded file, which is deleted at the end of the request."""
        file = UploadedFile(upload.file, upload.filename)
        on_request_end(self._request.scope, file.close)
        return file


@dataclass(frozen=True)
class _Expected:
    """Parts that a route expects.

    Attributes:
        needed: names of required files.
        files: names of all files, those that can be sent instead of others included.
        repeated, substitutes: see `read_parts`.
    """

    needed: set[str]
    files: set[str]
    fields: set[str]
    repeated: Mapping[str, Repeats]
    substitutes: Mapping[str, str]

    @classmethod
    def of(
        cls, files: set[str], fields: set[str], repeated: Mapping[str, Repeats], substitutes: Mapping[str, str]
    ) -> Self:
        """Return the expected parts for the arguments of `read_parts`; a substitute is repeated like its file."""
        needed = files | (repeated.keys() - substitutes.keys())
        also = {other: repeated[name] for other, name in substitutes.items() if name in repeated}
        return cls(needed, needed | substitutes.keys(), fields, {**also, **repeated}, substitutes)

    def refusal(self, message: str, name: str, *, is_file: bool) -> errors.ServiceError:
        """Return the error for a message of the parser about the part of this name."""
        if self.repeated and message.startswith(_TOO_MANY_FILES):
            several = [(name, repeats) for name, repeats in self.repeated.items() if repeats.most > 1]
            faults = [(name, repeats.fault(f"more than {repeats.most}")) for name, repeats in several]
            return errors.InvalidRequestError([fault for fault in faults if fault[0] not in self.substitutes])
        if message.startswith(_TOO_LARGE_PART):
            return errors.InvalidRequestError([(name, _NO_FILE if is_file else _LARGE_FIELD)])
        return errors.MalformedRequestError(f"not valid {MULTIPART}: {message}")

    def sort(self, items: list[tuple[str, UploadedFile | str]], limits: UploadLimits, check: Check) -> Parts:
        found, counts = Parts({}, {}), Counter[str]()
        added = [(part[:50], self._add(part, value, limits, found, counts)) for part, value in items]
        faults = [(label, fault) for label, fault in added if fault]
        given = {name for name, _ in items}
        substituted = {name for other, name in self.substitutes.items() if other in given}
        faults.extend((name, "is missing") for name in sorted(self.needed - given - substituted))
        for name in sorted(set(self.substitutes.values())):
            kinds = [kind for kind in (name, *self.substitutes) if self.substitutes.get(kind, name) == name]
            kinds = [kind for kind in kinds if kind in given]
            faults.extend((kind, f"is given beside {kinds[0]}; send one of the two") for kind in kinds[1:])
        for name, repeats in self.repeated.items():
            if name in given and not repeats.least <= counts[name] <= repeats.most:
                faults.append((name, repeats.fault(str(counts[name]))))
        faults.extend(check(found.fields))
        if faults:
            raise errors.InvalidRequestError(faults)
        return found

    def _add(
        self, part: str, value: UploadedFile | str, limits: UploadLimits, found: Parts, counts: Counter[str]
    ) -> str:
        """Add a part to those of its kind; return what is wrong with it, if anything."""
        if part not in self.files | self.fields:
            return f"unknown part; known: {', '.join(sorted(self.files | self.fields))}"
        name = part
        if part in self.repeated:
            name = f"{part}[{counts[part]}]"
            counts[part] += 1
        if name in found.fields or name in found.files:
            return "given more than once"
        if part in self.fields:
            if isinstance(value, UploadedFile):
                return "must be a plain field, not a file"
            found.fields[name] = value
        elif isinstance(value, UploadedFile):
            if len(value) > limits.max_bytes:
                raise errors.UploadTooLargeError(limits.name, limits.max_bytes, len(value))
            found.files[name] = value
        else:
            return _NO_FILE
        return ""


async def _within_parts(
    chunks: AsyncGenerator[bytes, None], boundary: bytes, limit: int
) -> AsyncGenerator[bytes, None]:
    """Yield a multipart body whose boundary occurs a bounded number of times.

    A boundary costs the parser as much as hundreds of bytes, also if the next bytes show that it is none.
    """
    found = 0
    async for chunk in chunks:
        found += chunk.count(b"--" + boundary)
        if found > limit + 1:
            raise errors.MalformedRequestError(
                f"the boundary occurs more than {limit} times; choose one that does not occur in the parts"
            )
        yield chunk
