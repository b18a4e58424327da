"""The lease that whoever computes a grid holds on it, and keeps alive meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic


class LeaseLostError(Exception):
    """Another replica took the work over, or the plan is gone."""


class LeaseHeartbeat:
    """Renews the lease of a job now and then.

    Attributes:
        lost: whether the lease is another's.
    """

    def __init__(self, renew: Callable[[], bool], every_s: float) -> None:
        self._renew = renew
        self._every_s = every_s
        self._beat_at = monotonic()
        self.lost = False

    def beat(self) -> None:
        """Renew the lease if it is time."""
        if not self.lost and monotonic() >= self._beat_at:
            self.lost = not self._renew()
            self._beat_at = monotonic() + self._every_s
