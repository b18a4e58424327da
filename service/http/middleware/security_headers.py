"""Security headers of answers; headers that a route sets itself are kept."""

from __future__ import annotations

from urllib.parse import urlsplit, urlunsplit

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Answers are data: nothing in them can run, load or be framed. The pages set their own policy.
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
    """Middleware that adds missing security headers, and HSTS over https."""

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
                # The server takes the scheme from X-Forwarded-Proto of trusted proxies.
                if scope["scheme"] == "https":
                    headers.setdefault("Strict-Transport-Security", f"max-age={_ONE_YEAR_S}")
            await send(message)

        await self._app(scope, receive, send_with_headers if scope["type"] == "http" else send)


def _without_host(target: str) -> str:
    """Return a redirect without the host, which the framework takes from the request and a client can forge."""
    return urlunsplit(urlsplit(target)._replace(scheme="", netloc=""))
