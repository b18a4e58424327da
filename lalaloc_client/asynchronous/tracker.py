"""Tracker of a moving camera."""

from __future__ import annotations

import uuid
from contextlib import suppress
from typing import Any, Unpack

from lalaloc_client.asynchronous.transport import AsyncTransport
from lalaloc_client.errors import ConflictError, NotFoundError
from lalaloc_client.options import ViewOptions
from lalaloc_client.parsing import parse
from lalaloc_client.requests import Photograph, Request, json_request, resource_path
from lalaloc_client.tracking import Motion, Session, SessionOptions

_OUT_OF_ORDER = "urn:lalaloc:problem:photograph-out-of-order"


class AsyncTracker:
    """Follows one camera; use it in an `async with` block, which begins the session and ends it.

    Photographs are numbered, so that one whose answer was lost is not counted twice.
    """

    def __init__(
        self, service: AsyncTransport, floorplan_id: str | None, venue_id: str | None, options: SessionOptions
    ) -> None:
        self._service = service
        given = {"floorplan_id": floorplan_id, "venue_id": venue_id, **options}
        self._document: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        self._session: Session | None = None

    async def __aenter__(self) -> AsyncTracker:
        await self.begin()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.end()

    @property
    def session(self) -> Session:
        """The session after the last photograph.

        Raises:
            RuntimeError: the session has not begun.
        """
        if self._session is None:
            raise RuntimeError("the session has not begun: use the tracker in a `with` block, or call `begin`")
        return self._session

    async def begin(self, session_id: str | None = None) -> Session:
        """Begin a session, or continue the one with this id."""
        if session_id is None:
            request = json_request("POST", "/sessions", self._document, idempotency_key=uuid.uuid4().hex)
        else:
            request = Request("GET", resource_path("sessions", session_id))
        self._session = parse(Session, await self._service.content(request))
        return self._session

    async def add(
        self,
        photograph: Photograph,
        motion: Motion | None = None,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        on_device: bool = False,
        **options: Unpack[ViewOptions],
    ) -> Session:
        """Send the next photograph; return the session with its pose.

        The motion is that since the photograph before, if it was measured. The default of the tolerance is 0.
        An app that knows gravity gives `pitch_deg` and `roll_deg`. All else is as for `localise`.
        """
        number = self.session.photographs + 1
        values = {"number": number, "heading_deg": heading_deg, "heading_tolerance_deg": heading_tolerance_deg}
        path = f"{resource_path('sessions', self.session.id)}/photographs"
        try:
            moved = {} if motion is None else motion.to_dict()
            content = await self._service.localise_query(
                path, [photograph], {**values, **moved}, options, on_device=on_device
            )
        except ConflictError as error:
            if error.type != _OUT_OF_ORDER:
                raise
            # An earlier attempt, whose answer was lost, has counted.
            session = await self.begin(self.session.id)
            if session.photographs != number:
                raise
            return session
        self._session = parse(Session, content)
        return self._session

    async def end(self) -> None:
        """Delete the session, unless it has expired."""
        if self._session is not None:
            path = resource_path("sessions", self._session.id)
            self._session = None
            with suppress(NotFoundError):
                await self._service.content(Request("DELETE", path))
