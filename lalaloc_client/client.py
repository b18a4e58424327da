"""The client that blocks."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

import httpx
from httpx_sse import EventSource

from lalaloc_client import operations, requests, venue_requests
from lalaloc_client.connection import http_options, request_to_send
from lalaloc_client.errors import NotFoundError
from lalaloc_client.events import Followed, check_stream
from lalaloc_client.model import (
    FloorPlan,
    FloorPlanSummary,
    Localisation,
    PlanEvent,
    Readiness,
    SequenceLocalisation,
    Venue,
    VenueAnchor,
    VenuePlan,
)
from lalaloc_client.operations import Patience, Reply, Steps, Wait
from lalaloc_client.requests import (
    Covariance,
    Document,
    Picture,
    PictureFormat,
    QueryOptions,
    Refine,
    Request,
    SequenceRefine,
)
from lalaloc_client.retry import RetryPolicy
from lalaloc_client.venue_requests import Unchanged

if TYPE_CHECKING:
    from PIL.Image import Image

T = TypeVar("T")


class Client:
    """Asks a LaLaLoc service; close it, or use it in a `with` block. May be shared between threads.

    Every method raises ProblemError when the service answers with a problem, ConnectionFailedError when it does not
    answer, and MalformedAnswerError when it answers something else; see `lalaloc_client.errors`.
    """

    def __init__(
        self, base_url: str, *, api_key: str | None = None, timeout_s: float = 60.0, retry: RetryPolicy | None = None
    ) -> None:
        """
        Args:
            base_url: address of the service, with `http://` or `https://`.
            api_key: sent as `Authorization: Bearer`.
            timeout_s: longest that connecting, sending or waiting for a part of an answer may take.
            retry: how often requests are sent again when the service is overloaded or does not answer.
        """
        self._http = httpx.Client(**http_options(base_url, api_key, timeout_s))
        self._patience = Patience(retry or RetryPolicy())

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def upload_floorplan(
        self, document: Document, *, options: Mapping[str, object] | None = None, idempotency_key: str | None = None
    ) -> FloorPlan:
        """Store a plan; its latent grid may still be computed afterwards, see `wait_until_ready`.

        Args:
            document: a mapping in the native format, or the bytes or path of a file of any format that the service
                reads: native JSON, GeoJSON, IMDF, SVG, DXF, IFC, PDF, PNG or JPEG.
            options: what the file does not say of itself, such as `{"metres_per_pixel": 0.01}` or `{"level": "1"}`.
            idempotency_key: the same key with the same plan is the same upload, whoever sends it again; by default a
                new one, which the retries of this call share.
        """
        return self._run(operations.plan(requests.upload_request(document, options, idempotency_key), self._patience))

    def replace_floorplan(
        self,
        floorplan_id: str,
        document: Document,
        *,
        options: Mapping[str, object] | None = None,
        if_match: str | None = None,
    ) -> FloorPlan:
        """Store a new revision of a plan.

        Args:
            document, options: as of `upload_floorplan`.
            if_match: the `etag` of the plan that it replaces; when that is no longer the newest one, ConflictError.
        """
        request = requests.replace_request(floorplan_id, document, options, if_match)
        return self._run(operations.plan(request, self._patience))

    def floorplan(self, floorplan_id: str) -> FloorPlan:
        """A stored plan."""
        return self._run(operations.plan(requests.plan_request(floorplan_id), self._patience))

    def floorplans(self, name: str | None = None, *, page_size: int = 100) -> Iterator[FloorPlanSummary]:
        """All stored plans, newest first, or those that the service finds by a name; asks page by page."""
        cursor = None
        while True:
            page = self._run(operations.page(requests.page_request(name, page_size, cursor), self._patience))
            yield from page.floorplans
            cursor = page.next_cursor
            if cursor is None:
                return

    def delete_floorplan(self, floorplan_id: str) -> None:
        """Delete a plan with everything that was made of it."""
        self._run(operations.delete(requests.delete_request(floorplan_id), self._patience))

    def original(self, floorplan_id: str) -> bytes:
        """The file that a plan's current revision was uploaded as, to the byte."""
        return self._run(operations.content(requests.original_request(floorplan_id), self._patience))

    def preview(
        self,
        floorplan_id: str,
        *,
        x_m: float | None = None,
        y_m: float | None = None,
        heading_deg: float | None = None,
        covariance_m2: Covariance | None = None,
    ) -> str:
        """A plan as an SVG drawing, on which one unit is one metre.

        Args:
            x_m, y_m: draw a camera here.
            heading_deg: its heading, as in `Localisation`.
            covariance_m2: of its position, as in `Localisation`: the ellipse that holds 95 % is drawn.
        """
        request = requests.preview_request(
            floorplan_id, x_m=x_m, y_m=y_m, heading_deg=heading_deg, covariance_m2=covariance_m2
        )
        return self._run(operations.content(request, self._patience)).decode()

    def export(self, floorplan_id: str, file_format: str) -> bytes:
        """A plan as a file: `native`, `geojson`, `imdf` (of a plan with an anchor), `dxf` or `svg`."""
        return self._run(operations.content(requests.export_request(floorplan_id, file_format), self._patience))

    def mesh(self, floorplan_id: str) -> bytes:
        """Floor, walls and ceilings of a plan as binary glTF (GLB), in metres and y-up."""
        return self._run(operations.content(requests.mesh_request(floorplan_id), self._patience))

    def events(self, floorplan_id: str) -> Iterator[PlanEvent]:
        """How far a plan is, told as it happens, until it is ready, failed or deleted.

        A stream that breaks off, or that the service ends after a while, is asked for anew.
        """
        request = requests.events_request(floorplan_id)
        followed = Followed()
        while not followed.over:
            try:
                response = self._run(operations.stream(request, self._patience))
            except NotFoundError as error:
                yield followed.deleted(error)
                return
            with closing(response):
                check_stream(response)
                try:
                    for message in EventSource(response).iter_sse():
                        if (event := followed.take(message)) is not None:
                            yield event
                except httpx.TransportError:
                    # As good as ended: what is missed comes first on the next one.
                    pass
            if not followed.over:
                self._do(followed.pause())

    def wait_until_ready(self, floorplan_id: str, *, timeout_s: float = 300.0) -> FloorPlan:
        """The plan, once its latent grid is computed.

        Raises:
            FloorPlanFailedError: it cannot be.
            NotReadyError: it was not within `timeout_s`.
        """
        return self._run(operations.ready_plan(floorplan_id, timeout_s, self._patience))

    def localise(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        near: Mapping[str, float] | None = None,
        radius_m: float | None = None,
        rooms: Sequence[str] | None = None,
        strict: bool | None = None,
        refine: Refine | None = None,
        top_k: int | None = None,
    ) -> Localisation:
        """Where in a plan a panorama was taken.

        Args:
            panorama: full sphere, twice as wide as high: the bytes or the path of a JPEG, PNG or WebP file, or a
                picture of PIL, which is sent as JPEG.
            heading_deg: azimuth of the picture's centre column, clockwise from the plan's +y; None: unknown, found.
            heading_tolerance_deg: how far off that may be, up to 45; None: not at all.
            camera_height_m: over the floor; None: the plan's, and if it has none, any.
            camera_height_std_m: standard deviation of that, which is solved for; None: the plan's, or 0.1; 0: exact.
            near: where the camera stood, about: {"x_m": 3.5, "y_m": 2.0}, in the plan.
            radius_m: how far from there it may have stood; needed with `near`.
            rooms: ids or names of rooms in one of which it stood.
            strict: whether nothing else is looked at than what hints and heading say; None: they may be wrong.
            refine: `none`, `vdr` or `lpo`, how far to go; None: as far as possible.
            top_k: how many candidates; None: as many as the service likes.
        """
        request = requests.localise_request(
            floorplan_id,
            panorama,
            heading_deg=heading_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
            near=near,
            radius_m=radius_m,
            rooms=rooms,
            strict=strict,
        )
        return self._run(operations.localisation(request, self._patience))

    def picture(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        picture: Picture = "both",
        *,
        picture_format: PictureFormat = "png",
        **asked: Unpack[QueryOptions],
    ) -> bytes:
        """Where in a plan a panorama was taken, as a picture 1600 pixels wide.

        Args:
            picture: `plan`, with the posterior as a heat map, the answer and its rivals; `photograph`, with the found
                layout drawn in; or `both`.
            picture_format: `png` or `svg`.

        The others are those of `localise`.
        """
        query = requests.localise_request(
            floorplan_id,
            panorama,
            **asked,
        )
        request = requests.picture_request(query, picture, picture_format)
        return self._run(operations.content(request, self._patience))

    def make_venue(
        self,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        idempotency_key: str | None = None,
    ) -> Venue:
        """Group stored plans, so that a panorama can be searched for in all of them: see `localise_in_venue`.

        Args:
            idempotency_key: as of `upload_floorplan`.
        """
        request = venue_requests.make_request(plans, name, anchor, idempotency_key)
        return self._run(operations.venue(request, self._patience))

    def replace_venue(
        self,
        venue_id: str,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        if_match: str | None = None,
    ) -> Venue:
        """Give a venue other plans, name and anchor: what is left out, it has no more."""
        request = venue_requests.replace_request(venue_id, plans, name, anchor, if_match)
        return self._run(operations.venue(request, self._patience))

    def change_venue(
        self,
        venue_id: str,
        *,
        name: str | None = None,
        anchor: VenueAnchor | Unchanged | None = "unchanged",
        plans: Iterable[VenuePlan] = (),
        remove: Sequence[str] = (),
        if_match: str | None = None,
    ) -> Venue:
        """Change some of a venue.

        Args:
            name: None: as it is.
            anchor: None takes it away.
            plans: what comes in, or changes its level or name.
            remove: ids of plans that leave the venue.
            if_match: the `etag` of the venue that is changed; when that is no longer the newest one, ConflictError.
        """
        request = venue_requests.change_request(
            venue_id, name=name, anchor=anchor, plans=plans, remove=remove, if_match=if_match
        )
        return self._run(operations.venue(request, self._patience))

    def venue(self, venue_id: str) -> Venue:
        """A stored venue."""
        return self._run(operations.venue(venue_requests.venue_request(venue_id), self._patience))

    def venues(self, name: str | None = None, *, page_size: int = 100) -> Iterator[Venue]:
        """All stored venues, newest first, or those that the service finds by a name; asks page by page."""
        cursor = None
        while True:
            request = venue_requests.page_request(name, page_size, cursor)
            page = self._run(operations.venue_page(request, self._patience))
            yield from page.venues
            cursor = page.next_cursor
            if cursor is None:
                return

    def venue_plans(self, venue_id: str, *, level: float | None = None, page_size: int = 100) -> Iterator[VenuePlan]:
        """The plans of a venue from the lowest level up, or those of one level; asks page by page."""
        cursor = None
        while True:
            request = venue_requests.plans_request(venue_id, level, page_size, cursor)
            page = self._run(operations.venue_plan_page(request, self._patience))
            yield from page.plans
            cursor = page.next_cursor
            if cursor is None:
                return

    def delete_venue(self, venue_id: str) -> None:
        """Delete a venue; its plans stay."""
        self._run(operations.delete(venue_requests.delete_request(venue_id), self._patience))

    def localise_in_venue(
        self,
        venue_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        strict: bool | None = None,
        refine: Refine | None = None,
        top_k: int | None = None,
    ) -> Localisation:
        """In which plan of a venue a panorama was taken, and where; the arguments are those of `localise`."""
        request = requests.localise_request(
            None,
            panorama,
            venue_id=venue_id,
            heading_deg=heading_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
            strict=strict,
        )
        return self._run(operations.localisation(request, self._patience))

    def localise_sequence(
        self,
        floorplan_id: str,
        panoramas: Sequence[bytes | str | os.PathLike[str] | Image],
        *,
        motions: Sequence[Mapping[str, float] | None] | None = None,
        headings_deg: Sequence[float | None] | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        refine: SequenceRefine | None = None,
        top_k: int | None = None,
    ) -> SequenceLocalisation:
        """Where in a plan several panoramas of one visit were taken, answered jointly.

        Args:
            panoramas: in the order in which they were taken, each as for `localise`.
            motions: between neighbours, what was measured of {"distance_m": 2.4, "distance_std_m": 0.1, "turn_deg": 35,
                "turn_std_deg": 2, "direction_deg": 10, "direction_std_deg": 2}: the turn of the heading, clockwise, and
                the way's direction against the first heading. None where nothing was measured.
            headings_deg: of each panorama, None where it is unknown.
            heading_tolerance_deg: how far off those may be; None: not at all.
            camera_height_m, camera_height_std_m, top_k: as for `localise`; all panoramas share one height.
            refine: `none` or `lpo`, how far to go; None: as far as possible.
        """
        request = requests.sequence_request(
            floorplan_id,
            panoramas,
            motions=motions,
            headings_deg=headings_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
        )
        return self._run(operations.sequence(request, self._patience))

    def limits(self) -> Mapping[str, Any]:
        """What the service allows, by name."""
        return self._run(operations.limits(self._patience))

    def ready(self) -> Readiness:
        """Whether the service can answer at full quality."""
        return self._run(operations.readiness(self._patience))

    def _run(self, steps: Steps[T]) -> T:
        try:
            step = next(steps)
            while True:
                step = steps.send(self._do(step))
        except StopIteration as done:
            return done.value

    def _do(self, step: Request | Wait) -> Reply:
        if isinstance(step, Wait):
            time.sleep(step.duration_s)
            return Reply()
        try:
            response = self._http.send(request_to_send(self._http, step), stream=step.streamed)
            if step.streamed and response.status_code not in step.answers:
                response.read()
            return Reply(response)
        except httpx.TransportError as error:
            return Reply(failure=error)
