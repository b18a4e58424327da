"""Authorisation of requests, before their body is read, and their entries in the audit log."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.problems import http_problem_answer, problem_answer
from service.security.access_control import REFUSALS, AccessControl, routed_path
from service.security.audit import AUDITED_REFUSALS, CLIENT_CLOSED, READING, REFUSED, AuditTrail, entry_of, is_audited
from service.security.permissions import OPEN_PATHS, Caller, put_caller


class AuthorisationMiddleware:
    """Middleware that authorises requests with the app's `AccessControl` and attaches the caller."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        # An app without its lifespan has no access control.
        access: AccessControl | None = getattr(scope["app"].state, "access_control", None)
        if scope["type"] != "http" or access is None or routed_path(scope) in OPEN_PATHS:
            await self._app(scope, receive, send)
            return
        trail: AuditTrail = scope["app"].state.audit_trail
        request = Request(scope)
        try:
            caller = await access.authorise(request)
        except REFUSALS as error:
            answer = problem_answer(request, error)
            if isinstance(error, AUDITED_REFUSALS):
                trail.count(entry_of(scope, answer.status_code))
            await answer(scope, receive, send)
            return
        except HTTPException as error:
            await http_problem_answer(request, error)(scope, receive, send)
            return
        put_caller(scope, caller)
        await self._observed(trail, access, caller, scope, receive, send)

    async def _observed(
        self, trail: AuditTrail, access: AccessControl, caller: Caller, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Handle a request, store its entry before the answer begins, and charge the caller for the bytes of a read.

        A request that is not audited has an entry only if its route refuses it.
        """
        audited, is_read = is_audited(scope), scope["method"] in READING
        noted, sent_bytes = False, 0

        async def sending(message: Message) -> None:
            nonlocal noted, sent_bytes
            sent_bytes += len(message.get("body", b""))
            if message["type"] == "http.response.start" and not noted and (audited or message["status"] in REFUSED):
                noted = True
                status, location = message["status"], Headers(raw=message["headers"]).get("location")
                entry = entry_of(scope, status, caller=caller, location=location)
                if status < 400 and not is_read:
                    await trail.record(entry)
                else:
                    trail.count(entry)
            await send(message)

        try:
            await self._app(scope, receive, sending)
        finally:
            if audited and not noted:
                trail.count(entry_of(scope, CLIENT_CLOSED, caller=caller))
            if is_read:
                await access.charge(caller, sent_bytes)
