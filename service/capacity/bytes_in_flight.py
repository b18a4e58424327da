"""Budget of the request bodies in progress, per client and in total."""

from __future__ import annotations

from collections.abc import Callable

from service.capacity.fair_share import Shares
from service.errors import BytesInFlightError, UploadTooLargeError

TENANT_SETTING, TOTAL_SETTING = "LALALOC_UPLOAD_TENANT_BYTES", "LALALOC_UPLOAD_TOTAL_BYTES"
# A client holds at most this many times the bytes that stay free, as in `service.capacity.fair_share`.
_MAX_RATIO = 3
# Budget that a body of unknown length takes at a time.
_STEP_BYTES = 2**20


class BytesInFlight(Shares):
    """Bytes of request bodies in progress, from their heads to the end of their answers; for one event loop.

    Args:
        total_bytes: limit of all clients together.
        limit_of: returns the limit (bytes) of a client.
    """

    def __init__(self, total_bytes: int, limit_of: Callable[[str], int]) -> None:
        super().__init__(total_bytes)
        self._limit_of = limit_of

    def limit_of(self, client: str) -> int:
        """Return the limit (bytes) of a client."""
        return min(self._limit_of(client), self.limit)

    def take(self, client: str, count: int = 1) -> None:
        """Take some bytes for a client."""
        held, limit = self.held_by(client), self.limit_of(client)
        if count > limit:
            raise UploadTooLargeError(TENANT_SETTING, limit, count)
        if held + count > limit:
            raise BytesInFlightError(count, held, limit, TENANT_SETTING)
        left = self.limit - self.in_use - count
        if left < 0 or (held and held + count > _MAX_RATIO * left):
            raise BytesInFlightError(count, self.in_use, self.limit, TOTAL_SETTING)
        super().take(client, count)


class BodyBudget:
    """Budget of one request's body.

    Args:
        budget: budget of all bodies.
        client: client of the request.
        stated_bytes: length in the head of the request; None if it gives none.
    """

    def __init__(self, budget: BytesInFlight, client: str, stated_bytes: int | None) -> None:
        self._budget = budget
        self._client = client
        self._stated_bytes = stated_bytes
        self._taken = self._received = 0

    def begin(self) -> None:
        """Take the stated length, or the first step, before the body is read; raises as `BytesInFlight.take` does."""
        self._take(_STEP_BYTES if self._stated_bytes is None else self._stated_bytes)

    def receive(self, count: int) -> None:
        """Count received bytes, and take the next step if they exceed what was taken; raises as `begin` does."""
        self._received += count
        while self._received > self._taken:
            self._take(_STEP_BYTES)

    def end(self) -> None:
        """Give everything back."""
        self._budget.give_back(self._client, self._taken)
        self._taken = 0

    def _take(self, count: int) -> None:
        self._budget.take(self._client, count)
        self._taken += count
