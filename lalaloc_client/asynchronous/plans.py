"""Floor plans and venues of the client for asyncio."""

from __future__ import annotations

import uuid
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import aclosing
from typing import Any, Literal

import httpx
from httpx_sse import EventSource

from lalaloc_client.asynchronous.albums import AsyncAlbums
from lalaloc_client.asynchronous.backend import run_blocking, sleep
from lalaloc_client.errors import FloorPlanFailedError, MalformedAnswerError, NotFoundError, NotReadyError
from lalaloc_client.model import (
    FloorPlan,
    FloorPlanSummary,
    ImportStep,
    Layout,
    Localisability,
    PlanEvent,
    Venue,
    VenueAnchor,
    VenuePlan,
)
from lalaloc_client.parsing import parse
from lalaloc_client.requests import (
    JSON,
    PICTURE_MEDIA,
    Covariance,
    Document,
    Request,
    json_request,
    plan_request,
    preview_params,
    resource_path,
    text_values,
)
from lalaloc_client.retry import Safety

_SVG = PICTURE_MEDIA["svg"]
# Pause between two streams of events until the service sends its own, as it does at the start of each stream.
_RECONNECT_S = 3.0


class AsyncPlans(AsyncAlbums):
    """Methods about floor plans and venues."""

    # Floor plans

    async def upload_floorplan(
        self,
        document: Document,
        *,
        options: Mapping[str, object] | None = None,
        idempotency_key: str | None = None,
        on_step: Callable[[ImportStep], None] | None = None,
    ) -> FloorPlan:
        """Store a plan; its pose grid may still be computed afterwards, see `wait_until_ready`.

        Args:
            document: a mapping in the native format, or the bytes or path of a file in any format that the service
                reads: native JSON, GeoJSON, IMDF, SVG, DXF, IFC, PDF, PNG or JPEG.
            options: import options for facts that the file does not state, such as `{"metres_per_pixel": 0.01}` or
                `{"level": "1"}`.
            idempotency_key: uploads of the same plan with the same key are one upload. Default: a new key, which the
                retries of this call share.
            on_step: called with every step of the import as it begins; a service of an older version calls it never.
        """
        key = idempotency_key or uuid.uuid4().hex
        request = await run_blocking(
            plan_request, "POST", "/floorplans", document, options, idempotency_key=key, on_step=on_step
        )
        return await self._stored(FloorPlan, request)

    async def replace_floorplan(
        self,
        floorplan_id: str,
        document: Document,
        *,
        options: Mapping[str, object] | None = None,
        if_match: str | None = None,
    ) -> FloorPlan:
        """Store a new revision of a plan.

        `document` and `options` are as for `upload_floorplan`. If `if_match`, the `etag` of the revision to replace, is
        not that of the latest one: ConflictError.
        """
        path = resource_path("floorplans", floorplan_id)
        request = await run_blocking(plan_request, "PUT", path, document, options, if_match=if_match)
        return await self._stored(FloorPlan, request)

    async def floorplan(self, floorplan_id: str) -> FloorPlan:
        """Return a stored plan."""
        return await self._stored(FloorPlan, Request("GET", resource_path("floorplans", floorplan_id)))

    def floorplans(self, name: str | None = None, *, page_size: int = 100) -> AsyncIterator[FloorPlanSummary]:
        """Yield the stored plans, newest first, page by page; with `name`, those with this text in their name."""
        return self._listed(FloorPlanSummary, "/floorplans", name=name, limit=page_size)

    async def delete_floorplan(self, floorplan_id: str) -> None:
        """Delete a plan and everything that was derived from it."""
        await self._send(Request("DELETE", resource_path("floorplans", floorplan_id)))

    async def original(self, floorplan_id: str) -> bytes:
        """Return the file of a plan's current revision exactly as it was uploaded."""
        return await self._part(floorplan_id, "original")

    async def preview(
        self,
        floorplan_id: str,
        *,
        x_m: float | None = None,
        y_m: float | None = None,
        heading_deg: float | None = None,
        covariance_m2: Covariance | None = None,
    ) -> str:
        """Return a plan as an SVG drawing in which one unit is one metre.

        `x_m`, `y_m` and `heading_deg` are the pose of a camera to draw, and `covariance_m2`, as in `Localisation`, is
        drawn as the ellipse that contains 95 % of its positions.
        """
        params = preview_params(x_m, y_m, heading_deg, covariance_m2)
        return (await self._part(floorplan_id, "preview.svg", _SVG, **params)).decode()

    async def export(self, floorplan_id: str, file_format: str) -> bytes:
        """Return a plan as a file: `native`, `geojson`, `imdf` (for plans with an anchor), `dxf` or `svg`."""
        return await self._part(floorplan_id, "export", format=file_format)

    async def layout(self, floorplan_id: str, *, revision: str | None = None) -> Layout:
        """Return the walls and openings of a plan, room by room, from which a camera's view can be drawn.

        `revision` is an older revision, while the service keeps it. Default: the current one.
        """
        return parse(Layout, await self._part(floorplan_id, "layout", **text_values({"revision": revision})))

    async def mesh(self, floorplan_id: str) -> bytes:
        """Return floor, walls and ceilings of a plan as binary glTF (GLB), in metres and y-up."""
        return await self._part(floorplan_id, "mesh.glb", "model/gltf-binary")

    async def localisability(self, floorplan_id: str, *, coarse: bool = False) -> Localisability:
        """Return which photographs of a plan will be found, predicted from the plan and the model's measured errors.

        A `coarse` prediction is rough and takes a fifth of the time.
        """
        params = {"coarse": "true"} if coarse else {}
        return parse(Localisability, await self._part(floorplan_id, "localisability", **params))

    async def localisability_map(
        self,
        floorplan_id: str,
        photograph: Literal["sphere", "phone", "three_phone"] = "phone",
        heading: Literal["known", "unknown"] = "unknown",
    ) -> str:
        """Return an SVG drawing of the probability by place that a photograph is found."""
        picture = await self._part(floorplan_id, "localisability.svg", _SVG, photograph=photograph, heading=heading)
        return picture.decode()

    async def _part(self, floorplan_id: str, name: str, accept: str = JSON, **params: str | list[str]) -> bytes:
        """Return the content of a resource of a plan."""
        path = f"{resource_path('floorplans', floorplan_id)}/{name}"
        return await self.content(Request("GET", path, params, {"Accept": accept}))

    async def events(self, floorplan_id: str) -> AsyncIterator[PlanEvent]:
        """Yield the progress of a plan until it is ready, failed or deleted.

        Reconnects if a stream breaks off or if the service ends it.
        """
        headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
        request = Request("GET", f"{resource_path('floorplans', floorplan_id)}/events", headers=headers, streamed=True)
        last, reconnect_s = None, _RECONNECT_S
        while last is None or not last.final:
            try:
                response = await self._send(request)
            except NotFoundError:
                if last is None:
                    raise
                yield PlanEvent("deleted")
                return
            async with aclosing(response):
                media = response.headers.get("content-type", "").partition(";")[0].strip()
                if media != "text/event-stream":
                    raise MalformedAnswerError(f"the answer is of type '{media[:100]}'; expected a stream of events")
                try:
                    async for message in EventSource(response).aiter_sse():
                        if message.retry is not None:
                            reconnect_s = message.retry / 1000.0
                        if message.data:
                            event = parse(PlanEvent, message.data, "event")
                            if event != last:
                                yield event
                            last = event
                except httpx.TransportError:
                    # The next stream begins with the current state, so nothing is missed.
                    pass
            if last is None or not last.final:
                await sleep(reconnect_s)

    async def wait_until_ready(self, floorplan_id: str, *, timeout_s: float = 300.0) -> FloorPlan:
        """Wait until a plan's pose grid is computed and return the plan.

        Raises:
            FloorPlanFailedError: the service could not prepare the plan.
            NotReadyError: the plan is still preparing after `timeout_s`.
        """
        path = resource_path("floorplans", floorplan_id)
        plan, spent_s = await self._polled(FloorPlan, path, lambda plan: plan.status in ("ready", "failed"), timeout_s)
        if plan.status == "failed":
            raise FloorPlanFailedError(floorplan_id, plan.reason)
        if plan.status != "ready":
            raise NotReadyError(floorplan_id, spent_s, plan.progress)
        return plan

    # Venues

    async def make_venue(
        self,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        idempotency_key: str | None = None,
    ) -> Venue:
        """Group stored plans in a venue; `localise_in_venue` searches all of them.

        The anchor is the location of the plans' common origin on Earth; `idempotency_key` is as for `upload_floorplan`.
        """
        key = idempotency_key or uuid.uuid4().hex
        document = _venue_document(plans, name, anchor)
        return await self._stored(Venue, json_request("POST", "/venues", document, idempotency_key=key))

    async def upload_venue(
        self,
        file: Document,
        *,
        name: str | None = None,
        options: Mapping[str, object] | None = None,
        idempotency_key: str | None = None,
        on_step: Callable[[ImportStep], None] | None = None,
    ) -> Venue:
        """Store a plan of every level of a file, and a venue of these plans; see `venue_plans`.

        The name of the venue also begins the names of several plans: "Duplex – Level 1". Default: the name of the file.
        All else is as for `upload_floorplan`; the options have no `level`.
        """
        key = idempotency_key or uuid.uuid4().hex
        values = dict(options or {}, name=name)
        request = await run_blocking(
            plan_request, "POST", "/venues", file, values, idempotency_key=key, on_step=on_step
        )
        return await self._stored(Venue, request)

    async def replace_venue(
        self,
        venue_id: str,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        if_match: str | None = None,
    ) -> Venue:
        """Replace plans, name and anchor of a venue; what is left out is removed."""
        document = _venue_document(plans, name, anchor)
        request = json_request("PUT", resource_path("venues", venue_id), document, if_match=if_match)
        return await self._stored(Venue, request)

    async def change_venue(
        self,
        venue_id: str,
        *,
        name: str | None = None,
        anchor: VenueAnchor | Literal["unchanged"] | None = "unchanged",
        plans: Iterable[VenuePlan] = (),
        remove: Sequence[str] = (),
        if_match: str | None = None,
    ) -> Venue:
        """Change parts of a venue.

        Parts that are left out are kept; the anchor None removes it. `plans` are added, or get another level or name;
        `remove` has ids of plans. If `if_match`, the `etag` of the revision to change, is not that of the latest one:
        ConflictError.
        """
        change: dict[str, Any] = {} if name is None else {"name": name}
        if anchor != "unchanged":
            change["anchor"] = None if anchor is None else anchor.to_dict()
        if added := [plan.to_dict() for plan in plans]:
            change["plans"] = added
        if remove:
            change["remove"] = [remove] if isinstance(remove, str) else list(remove)
        path = resource_path("venues", venue_id)
        # A plan can be removed once: the service may refuse a repeated request.
        request = json_request("PATCH", path, change, if_match=if_match, safety=Safety.UNSENT)
        return await self._stored(Venue, request)

    async def extend_venue(
        self,
        venue_id: str,
        file: Document,
        *,
        options: Mapping[str, object] | None = None,
        idempotency_key: str | None = None,
        if_match: str | None = None,
    ) -> Venue:
        """Store a plan of every level of a file, and add these plans to a venue; see `venue_plans`.

        A document `{"plans": [...]}` has up to 200 plans in the native format, each with an optional `level`: a venue
        of thousands of plans is uploaded in a fraction of the time that single uploads take.

        Options are as for `upload_venue`; their `name` begins the names of several plans instead of that of the venue.
        """
        key = idempotency_key or uuid.uuid4().hex
        path, values = resource_path("venues", venue_id), {"name": None, **(options or {})}
        request = await run_blocking(plan_request, "PATCH", path, file, values, if_match=if_match, idempotency_key=key)
        return await self._stored(Venue, request)

    async def venue(self, venue_id: str) -> Venue:
        """Return a stored venue."""
        return await self._stored(Venue, Request("GET", resource_path("venues", venue_id)))

    def venues(self, name: str | None = None, *, page_size: int = 100) -> AsyncIterator[Venue]:
        """Yield the stored venues, newest first, page by page; with `name`, those with this text in their name."""
        return self._listed(Venue, "/venues", name=name, limit=page_size)

    def venue_plans(
        self, venue_id: str, *, level: float | None = None, page_size: int = 100
    ) -> AsyncIterator[VenuePlan]:
        """Yield the plans of a venue, or of one of its levels, from the lowest level up, page by page."""
        path = f"{resource_path('venues', venue_id)}/plans"
        return self._listed(VenuePlan, path, level=level, limit=page_size)

    async def delete_venue(self, venue_id: str) -> None:
        """Delete a venue; its plans stay stored."""
        await self._send(Request("DELETE", resource_path("venues", venue_id)))


def _venue_document(plans: Iterable[VenuePlan], name: str | None, anchor: VenueAnchor | None) -> dict[str, Any]:
    given = {"name": name, "anchor": None if anchor is None else anchor.to_dict()}
    stated = {key: value for key, value in given.items() if value is not None}
    return {"plans": [plan.to_dict() for plan in plans], **stated}
