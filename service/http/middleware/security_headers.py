"""Security headers on every answer; what a route sets itself is left as it is."""

from __future__ import annotations

from urllib.parse import urlsplit, urlunsplit

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Answers are data: nothing in them may run, load or be framed. The pages set a policy of their own.
_ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_ONE_YEAR_S = 365 * 24 * 3600


class SecurityHeadersMiddleware:
    """Adds the headers that an answer does not have yet, and over https that browsers shall stay with https."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _ALWAYS.items():
                    headers.setdefault(name, value)
                if (target := headers.get("location")) is not None:
                    headers["location"] = _without_host(target)
                # Behind a proxy the server takes the scheme from X-Forwarded-Proto of proxies that it trusts.
                if scope["scheme"] == "https":
                    headers.setdefault("Strict-Transport-Security", f"max-age={_ONE_YEAR_S}")
            await send(message)

        await self._app(scope, receive, send_with_headers if scope["type"] == "http" else send)


def _without_host(target: str) -> str:
    """A redirect within the service: the framework's name the host that the request named, whoever made that up."""
    return urlunsplit(urlsplit(target)._replace(scheme="", netloc=""))
