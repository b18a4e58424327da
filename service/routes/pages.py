"""Web pages: the application at `/` and the API documentation at `/docs`, built from `web/` by `make web`.

Nothing is inline or loaded from elsewhere. The pages need no API key; they ask for one before they call the API.
"""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from importlib.resources import files
from mimetypes import guess_type

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.http.representations import digest_etag, not_modified, tagged_answer

router = APIRouter(include_in_schema=False)

_HEADERS = {
    # `blob:` is for pictures that were chosen on the page.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self' blob:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    # “Look around” uses the camera and, for directions, the sensors of a phone.
    "Permissions-Policy": "camera=(self), microphone=(), accelerometer=(self), gyroscope=(self), magnetometer=(self)",
    # Browsers revalidate each time, because another version can answer next.
    "Cache-Control": "no-cache",
}
# Script of the worker that computes features. Only it may compile WebAssembly, and it loads scripts and files of this
# service only.
_WORKER = "on_device.js"
_WORKER_HEADERS = _HEADERS | {
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'"
}
_PAGES = {"/": "index.html", "/pin": "pin.html", "/docs": "docs.html", "/favicon.ico": "icon.svg"}
_MAX_FILES = 64
_NAME = re.compile(r"[A-Za-z0-9_-]+(?:\.[a-z0-9]+)+")


@router.get("/")
@router.get("/pin")
@router.get("/docs")
@router.get("/favicon.ico")
def page(request: Request) -> Response:
    """Return a page, or the icon."""
    return _file(request, _PAGES[request.scope["route"].path])


@router.get("/web/{name}")
def part(request: Request, name: str) -> Response:
    """Return a script, style or example of the pages."""
    return _file(request, name)


def _file(request: Request, name: str) -> Response:
    if not _NAME.fullmatch(name):
        raise HTTPException(404)
    content, media, etag = _built(name)
    headers = _WORKER_HEADERS if name == _WORKER else _HEADERS
    return not_modified(request, etag, headers) or tagged_answer([content], media, etag, headers)


@lru_cache(_MAX_FILES)
def _built(name: str) -> tuple[bytes, str, str]:
    """Return content, media type and entity tag of a built file, which never changes while the service runs."""
    path = files("service") / "web" / name
    if not path.is_file():
        raise HTTPException(404)
    content = path.read_bytes()
    kind, compression = guess_type(name)
    # The page unpacks compressed files itself.
    media = "text/javascript" if name.endswith(".js") else (kind if compression is None else None)
    media = media or "application/octet-stream"
    return content, media, digest_etag(hashlib.sha256(content).hexdigest())
