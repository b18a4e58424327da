"""The web pages: one to use the service, one about its API. What they are made of is built from `web/` by `make web`.

Nothing is loaded from elsewhere, nothing is inline, and with API keys on they are the only routes without: they ask for
a key themselves.
"""

from __future__ import annotations

import re
from importlib.resources import files
from mimetypes import guess_type

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from service.http.conditional import conditional_answer, content_etag

router = APIRouter(include_in_schema=False)

_HEADERS = {
    # Pictures that are chosen on the page are shown from memory: `blob:`.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self' blob:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    # A browser asks each time whether its copy is still good: another version may answer next.
    "Cache-Control": "no-cache",
}
_NAME = re.compile(r"[A-Za-z0-9_-]+(?:\.[a-z0-9]+)+")


@router.get("/")
def index(request: Request) -> Response:
    """The page that shows where photographs were taken."""
    return _file(request, "index.html")


@router.get("/docs")
def docs(request: Request) -> Response:
    """The API's documentation."""
    return _file(request, "docs.html")


@router.get("/web/{name}")
def part(request: Request, name: str) -> Response:
    """Scripts, styles and examples of the pages."""
    return _file(request, name)


@router.get("/favicon.ico")
def icon(request: Request) -> Response:
    """What browsers show beside the title, and ask for also where no page names it."""
    return _file(request, "icon.svg")


def _file(request: Request, name: str) -> Response:
    """Raises:
    HTTPException: there is no such file.
    """
    path = files("service") / "web" / name
    if not _NAME.fullmatch(name) or not path.is_file():
        raise HTTPException(404)
    content = path.read_bytes()
    media = "text/javascript" if name.endswith(".js") else guess_type(name)[0] or "application/octet-stream"
    return conditional_answer(request, content, media, content_etag(content), _HEADERS)
