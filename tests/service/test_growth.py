"""Parsing time of requests, which grows at most linearly with their size."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

import pytest
from starlette.requests import Request

from lalaloc_core.errors import LaLaLocError
from service.http.idempotent_request import _key_of
from service.http.representations import expected_revision
from service.http.uploads import UploadLimits, read_parts
from service.routes.dependencies import parse_cursor
from service.security.access_control import is_allowed_host
from service.security.keys import parse_authorization
from service.telemetry.logs import parse_traceparent
from tests.growth import assert_no_worse_than_linear
from tests.service.test_uploads import request_of

# Slightly more than the maximum size of a request's head.
_HEAD = 12_000
_LIMITS = UploadLimits(
    max_bytes=10**8, name="max_photograph_bytes", deadline_s=60.0, idle_s=60.0, bytes_per_s=1.0, memory_bytes=2**20
)


def _request(name: str, value: str) -> Request:
    headers = [(name.encode(), value.encode("latin-1"))]
    return Request({"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": headers})


def _assert_linear(make: Callable[[int], str], parse: Callable[[str], object]) -> None:
    """Check that the time to parse a text of a head, or to refuse it, grows at most linearly with its size."""

    def make_work(size: int) -> Callable[[], None]:
        text = make(size)

        def work() -> None:
            with suppress(LaLaLocError):
                parse(text)

        return work

    assert_no_worse_than_linear(make_work, _HEAD)


_TAGS: dict[str, Callable[[int], str]] = {
    "tags": lambda size: ",".join(['"a"'] * (size // 4)),
    "commas": lambda size: "," * size,
    "blanks": lambda size: '"a"' + " " * size + "x",
    "commas and blanks": lambda size: '"a"' + ", " * (size // 2) + "x",
    "weak": lambda size: "W/" * (size // 2),
    "open": lambda size: '"' + "a" * size,
    "quotes": lambda size: '"' * size,
}


@pytest.mark.parametrize("kind", _TAGS)
def test_entity_tag_parsing_is_linear(kind: str) -> None:
    _assert_linear(_TAGS[kind], lambda text: expected_revision(_request("if-match", text), "p", "r"))


_PARSED: dict[str, Callable[[str], object]] = {
    "traceparent": lambda text: parse_traceparent(["01-" + "1" * 32 + "-" + "2" * 16 + "-01" + text]),
    "cursor": parse_cursor,
    "authorization": lambda text: parse_authorization(["Bearer " + text]),
    "host": is_allowed_host,
    "idempotency key": lambda text: _key_of(_request("idempotency-key", text)),
}


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["a", "-", "_", " ", ":", "[", "1.", "%0a", "@", "-a"])
@pytest.mark.parametrize("kind", _PARSED)
def test_head_parsing_is_linear(kind: str, unit: str) -> None:
    _assert_linear(lambda size: unit * (size // len(unit)), _PARSED[kind])


_PART = b'--b\r\nContent-Disposition: form-data; name="photo"; filename="p"\r\n\r\n'
_BODIES: dict[str, Callable[[int], bytes]] = {
    "plain": lambda size: _PART + b"a" * size,
    "boundary's letter": lambda size: _PART + b"b" * size,
    "line ends": lambda size: _PART + b"\r\n" * (size // 2),
    "returns": lambda size: _PART + b"\r" * size,
    "nearly boundaries": lambda size: _PART + b"\r\n--" * (size // 4),
    "nearly the end": lambda size: _PART + b"\r\n--a" * (size // 5),
    "dashes": lambda size: _PART + b"-" * size,
    "before the first": lambda size: b"-" * size,
    "after the last": lambda size: _PART + b"\r\n--b--\r\n" + b"a" * size,
    "one header": lambda size: _PART[:-2] + b"X-A: " + b"a" * size,
    "many headers": lambda size: _PART[:-2] + b"X-A: a\r\n" * (size // 8),
    "parts": lambda size: b'--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n\r\n' * (size // 50),
    "parameters": lambda size: b"--b\r\nContent-Disposition: form-data" + b"; a=b" * (size // 5) + b"\r\n\r\n",
    "escapes": lambda size: b'--b\r\nContent-Disposition: form-data; name="' + b'\\"' * (size // 2) + b"\r\n\r\n",
}


def _reading(content: bytes, media: str, chunk: int = 65_536) -> Callable[[], None]:
    """Return the work of reading a form."""

    async def read() -> None:
        scope, receive = request_of(content, media, chunk)
        with suppress(LaLaLocError):
            await read_parts(Request(scope, receive), _LIMITS, files={"photo"}, fields={"x"})

    return lambda: asyncio.run(read())


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [65_536, 512])
@pytest.mark.parametrize("kind", _BODIES)
def test_form_parsing_is_linear(kind: str, chunk: int) -> None:
    media = "multipart/form-data; boundary=b"
    assert_no_worse_than_linear(lambda size: _reading(_BODIES[kind](size), media, chunk), 300_000)


@pytest.mark.parametrize("unit", [";", "; a=b", '; a="', "\\", '"', "=", "; charset", " "])
def test_media_type_parsing_is_linear(unit: str) -> None:
    begin = "multipart/form-data; boundary=b"
    assert_no_worse_than_linear(lambda size: _reading(b"", begin + unit * (size // len(unit))), _HEAD)
