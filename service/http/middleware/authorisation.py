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
        if is_audited(scope):
            await self._audited(trail, access, caller, scope, receive, send)
        else:
            await self._refusing(trail, access, caller, scope, receive, send)

    async def _refusing(
        self, trail: AuditTrail, access: AccessControl, caller: Caller, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Handle a request whose entry is stored only if its route refuses it."""

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] in REFUSED:
                trail.count(entry_of(scope, message["status"], caller=caller))
            await send(message)

        await self._handle(access, caller, scope, receive, sending)

    async def _audited(
        self, trail: AuditTrail, access: AccessControl, caller: Caller, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Handle a request, and store its entry before the answer begins."""
        noted = False

        async def sending(message: Message) -> None:
            nonlocal noted
            if message["type"] == "http.response.start" and not noted:
                noted = True
                status, location = message["status"], Headers(raw=message["headers"]).get("location")
                entry = entry_of(scope, status, caller=caller, location=location)
                if status < 400 and scope["method"] not in READING:
                    await trail.record(entry)
                else:
                    trail.count(entry)
            await send(message)

        try:
            await self._handle(access, caller, scope, receive, sending)
        finally:
            if not noted:
                trail.count(entry_of(scope, CLIENT_CLOSED, caller=caller))

    async def _handle(self, access: AccessControl, caller: Caller, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, and charge the caller for the bytes of the answer to a read."""
        if scope["method"] not in READING:
            await self._app(scope, receive, send)
            return
        sent_bytes = 0

        async def counting(message: Message) -> None:
            nonlocal sent_bytes
            sent_bytes += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, counting)
        finally:
            await access.charge(caller, sent_bytes)
