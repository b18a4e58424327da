"""What the client that blocks does with venues."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from lalaloc_client import operations, venue_requests
from lalaloc_client.model import Venue, VenueAnchor, VenuePlan
from lalaloc_client.sender import Sender
from lalaloc_client.venue_requests import Unchanged


class VenueMethods(Sender):
    """Methods of `Client` about venues."""

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
