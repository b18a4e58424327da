"""Authorisation of requests, before their body is read."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.problems import http_problem_answer, problem_answer
from service.security.access_control import REFUSALS, AccessControl, routed_path
from service.security.permissions import OPEN_PATHS, put_caller


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
                put_caller(scope, await access.authorise(request))
            except REFUSALS as error:
                await problem_answer(request, error)(scope, receive, send)
                return
            except HTTPException as error:
                await http_problem_answer(request, error)(scope, receive, send)
                return
        await self._app(scope, receive, send)
