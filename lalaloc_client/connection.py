"""How both clients connect."""

from __future__ import annotations

from typing import Any

import httpx

from lalaloc_client.requests import Request

# A stream that says nothing for longer is dead: heartbeats come every 15 s.
_SILENCE_S = 30.0


def http_options(base_url: str, api_key: str | None, timeout_s: float) -> dict[str, Any]:
    """Options of httpx's clients.

    Raises:
        ValueError: not an address of HTTP, or not what a key or a timeout can be.
    """
    address = httpx.URL(base_url)
    if address.scheme not in ("http", "https") or not address.host:
        raise ValueError(f"base_url is '{base_url}', it must begin with http:// or https:// and name a host")
    if not timeout_s > 0.0:
        raise ValueError(f"timeout_s is {timeout_s}, it must be above 0")
    headers = {"Accept": "application/json", "User-Agent": "lalaloc-client"}
    if api_key is not None:
        if not (api_key.isascii() and api_key.isprintable()) or not api_key or " " in api_key:
            # Not quoted: it may be most of a good one.
            raise ValueError("api_key must be printable ASCII without spaces, and not empty")
        headers["Authorization"] = f"Bearer {api_key}"
    return {"base_url": address, "headers": headers, "timeout": timeout_s}


def checked_max_queries(given: int | None) -> int | None:
    """How many queries may be under way, None if the service is to say.

    Raises:
        ValueError: fewer than 1.
    """
    if given is not None and given < 1:
        raise ValueError(f"max_queries is {given}, at least 1 is needed")
    return given


def request_to_send(http: httpx.Client | httpx.AsyncClient, request: Request) -> httpx.Request:
    """A request as httpx sends it."""
    made = http.build_request(
        request.method, request.path, params=request.params, headers=request.headers, content=request.content
    )
    if request.streamed:
        timeout: dict[str, Any] = made.extensions["timeout"]
        timeout["read"] = max(timeout["read"], _SILENCE_S)
    return made
