"""The web pages: a form that tries the service out, and the API's documentation. Nothing is loaded from elsewhere."""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter, Response

router = APIRouter(include_in_schema=False)

_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    # A browser asks each time whether its copy is still good: another version may answer next.
    "Cache-Control": "no-cache",
}


@router.get("/")
def index() -> Response:
    """The page that tries the service out."""
    return _page("index.html", "text/html")


@router.get("/docs")
def docs() -> Response:
    """The API's documentation."""
    return _page("docs.html", "text/html")


@router.get("/web/try.js")
def try_script() -> Response:
    """Script of the page that tries the service out."""
    return _page("try.js", "text/javascript")


@router.get("/web/docs.js")
def docs_script() -> Response:
    """Script of the documentation."""
    return _page("docs.js", "text/javascript")


@router.get("/web/style.css")
def style() -> Response:
    """Style of both pages."""
    return _page("style.css", "text/css")


@router.get("/favicon.ico")
def icon() -> Response:
    """What browsers show beside the title, and ask for also where no page names it."""
    return _page("icon.svg", "image/svg+xml")


def _page(name: str, media_type: str) -> Response:
    content = (files("service") / "web" / name).read_bytes()
    return Response(content, media_type=media_type, headers=_HEADERS)
