"""Multipart bodies: fields and files, with limits on their size and time, and checks of every part."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Self

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from service import errors
from service.http.uploads import MULTIPART, UploadLimits, counted_chunks, in_time, kept_file, memory_bytes_of, spooling
from service.uploaded_file import UploadedFile

# Boundaries and part headers, which do not count towards the limit.
_ENVELOPE_BYTES = 64 * 1024
_MAX_PARTS = 20
# The motions between 100 photographs have about 16 kB.
_MAX_FIELD_BYTES = 32 * 1024
# Beginning of the parser's message about more files than it was allowed to read.
_TOO_MANY_FILES = "Too many files"
# Beginning of its message about a part without a file name that exceeds `_MAX_FIELD_BYTES`.
_TOO_LARGE_PART = "Part exceeded maximum size"
_NO_FILE = "must be a file (a part with a file name)"
_LARGE_FIELD = f"has more than {_MAX_FIELD_BYTES} bytes, the limit of a field"
_UTF_8 = b"utf-8"


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


Check = Callable[[Mapping[str, str]], list[tuple[str, str]]]


def _no_fields(_fields: Mapping[str, str]) -> list[tuple[str, str]]:
    return []


async def read_parts(
    request: Request,
    limits: UploadLimits,
    *,
    files: set[str],
    fields: set[str],
    check: Check = _no_fields,
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

    Raises:
        UploadTooLargeError, UploadTimeoutError: a limit is exceeded.
    """
    stated = request.headers.get("content-type", "")
    options = parse_options_header(stated)[1]
    charset = options.get(b"charset", _UTF_8)
    if charset.lower() != _UTF_8:
        raise errors.UnsupportedMediaError(stated, (f"{MULTIPART}; charset=utf-8",))
    expected = _Expected.of(files, fields, repeated, substitutes)
    # One more than allowed, so that the error states the limit.
    max_files = max(_MAX_PARTS, *(repeats.most + 1 for repeats in repeated.values())) if repeated else _MAX_PARTS
    chunks = counted_chunks(request, limits, envelope_bytes=_ENVELOPE_BYTES)
    parser = _NamingParser(
        request.headers,
        _within_parts(chunks, options.get(b"boundary", b""), max_files + _MAX_PARTS),
        max_files=max_files,
        max_fields=_MAX_PARTS,
        max_part_size=_MAX_FIELD_BYTES,
    )
    parser.spool_max_size = memory_bytes_of(limits)
    try:
        with spooling(limits):
            async with in_time(limits):
                form = await parser.parse()
    except MultiPartException as error:
        name = parser.part_name[:50]
        raise expected.refusal(error.message, name, is_file=aliases.get(name, name) in expected.files) from error
    except FormParserError as error:
        raise errors.MalformedRequestError(f"not valid {MULTIPART}: {error}") from error
    uploaded = {
        id(value): kept_file(request, value) for _, value in form.multi_items() if isinstance(value, UploadFile)
    }
    items = [
        (aliases.get(name, name), value if isinstance(value, str) else uploaded[id(value)])
        for name, value in form.multi_items()
    ]
    return expected.sort(items, limits, check)


class _NamingParser(MultiPartParser):
    """Parser that tells the name of the part that it reads, for errors.

    Attributes:
        part_name: name of the last part whose head was read; empty before.
    """

    part_name = ""
    _header_name = _header_value = b""

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        """Read a piece of a header's name."""
        super().on_header_field(data, start, end)
        self._header_name += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        """Read a piece of a header's value."""
        super().on_header_value(data, start, end)
        self._header_value += data[start:end]

    def on_header_end(self) -> None:
        """Note the name of the part."""
        super().on_header_end()
        if self._header_name.lower() == b"content-disposition":
            self.part_name = parse_options_header(self._header_value)[1].get(b"name", b"").decode("utf-8", "replace")
        self._header_name = self._header_value = b""


@dataclass(frozen=True)
class _Expected:
    """Parts that a route expects.

    Attributes:
        needed: names of required files.
        files: names of all files, those that can be sent instead of others included.
        fields: names of optional fields.
        repeated: files that can be repeated.
        substitutes: other kinds of files, and the names of the files that they can be sent instead of.
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
        """Return the parts by kind."""
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
