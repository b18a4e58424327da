"""What the client that blocks does with floor plans."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing

import httpx
from httpx_sse import EventSource

from lalaloc_client import operations, requests
from lalaloc_client.errors import NotFoundError
from lalaloc_client.events import Followed, check_stream
from lalaloc_client.layout import Layout
from lalaloc_client.model import FloorPlan, FloorPlanSummary, PlanEvent
from lalaloc_client.requests import Covariance, Document
from lalaloc_client.sender import Sender


class PlanMethods(Sender):
    """Methods of `Client` about floor plans."""

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

    def layout(self, floorplan_id: str, *, revision: str | None = None) -> Layout:
        """The walls of a plan with the openings in them, room by room: what it takes to draw what a camera sees.

        Args:
            revision: an older one, while the service keeps it; None: the current one.
        """
        request = requests.layout_request(floorplan_id, revision)
        return self._run(operations.layout(request, self._patience))

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
