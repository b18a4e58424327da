"""Authorisation of requests, before their body is read."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.problems import http_problem_answer, problem_answer
from service.security.access_control import REFUSALS, AccessControl, routed_path
from service.security.permissions import OPEN_PATHS, Caller, put_caller

_READING = frozenset({"GET", "HEAD"})


class AuthorisationMiddleware:
    """Middleware that authorises requests with the app's `AccessControl` and attaches the caller."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        # An app without its lifespan has no access control.
        access: AccessControl | None = getattr(scope["app"].state, "access_control", None)
        if scope["type"] == "http" and access is not None and routed_path(scope) not in OPEN_PATHS:
            request = Request(scope)
            try:
                caller = await access.authorise(request)
            except REFUSALS as error:
                await problem_answer(request, error)(scope, receive, send)
                return
            except HTTPException as error:
                await http_problem_answer(request, error)(scope, receive, send)
                return
            put_caller(scope, caller)
            if scope["method"] in _READING:
                await self._read(access, caller, scope, receive, send)
                return
        await self._app(scope, receive, send)

    async def _read(self, access: AccessControl, caller: Caller, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a read, and charge the caller for the bytes of the answer."""
        sent_bytes = 0

        async def counting(message: Message) -> None:
            nonlocal sent_bytes
            sent_bytes += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, counting)
        finally:
            await access.charge(caller, sent_bytes)
