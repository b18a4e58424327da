"""Whether and when a request is sent again. Clock and chance are passed in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum

_TRY_LATER = frozenset({429, 503})
_CONFLICT = 409


class Safety(Enum):
    """What sending a request twice may do.

    Attributes:
        ANY: nothing that once does not: it may be sent again after any failure.
        UNSENT: something else: it is sent again only when the first one surely was not carried out.
    """

    ANY = "any"
    UNSENT = "unsent"


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """How patient a client is.

    Attributes:
        attempts: how often a request is sent at most, the first time included.
        total_s: no wait begins that would end later than this after the first attempt began.
        first_s: longest wait before the second attempt; doubles with each one.
        longest_s: longest wait, unless the service asks for more with Retry-After.
    """

    attempts: int = 6
    total_s: float = 60.0
    first_s: float = 0.25
    longest_s: float = 10.0

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise ValueError(f"attempts is {self.attempts}, at least 1 is needed")
        for name in ("total_s", "first_s", "longest_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value}, it must be a finite number of seconds and not negative")

    def wait_s(self, attempt: int, spent_s: float, asked_s: float | None, chance: float) -> float | None:
        """How long to wait after an attempt that failed; None when it was the last.

        Args:
            attempt: number of the attempt that failed, from 1.
            spent_s: time since the first attempt began.
            asked_s: what the service asked for; never less is waited.
            chance: 0 to 1, spreads clients that failed together.
        """
        if attempt >= self.attempts:
            return None
        backoff_s = min(self.first_s * 2.0 ** (attempt - 1), self.longest_s)
        wait_s = backoff_s * (0.5 + 0.5 * chance) if asked_s is None else asked_s + self.first_s * chance
        return wait_s if spent_s + wait_s <= self.total_s else None


def may_retry(safety: Safety, status: int | None, *, sent: bool, asked: bool = False) -> bool:
    """Whether a request may be sent again.

    Args:
        status: of the answer; None when there was none.
        sent: whether any of the request may have reached the service.
        asked: whether the answer has a Retry-After.
    """
    if status is None:
        return safety is Safety.ANY or not sent
    # A conflict that passes: the same request, whose answer was lost, is still in work.
    return status in _TRY_LATER or (status == _CONFLICT and asked)


def retry_after_s(value: str | None, date: str | None, now: datetime) -> float | None:
    """Seconds that a Retry-After asks for: a number of them, or a date of HTTP.

    Args:
        date: the answer's Date; a date is counted from there, so that clocks need not agree.
        now: counted from where there is no Date.
    """
    if value is None:
        return None
    if value.strip().isdecimal():
        # More digits than any wait has would not fit a float.
        return float(value.strip()[:9])
    until = _http_date(value)
    if until is None:
        return None
    return max((until - ((_http_date(date) if date else None) or now)).total_seconds(), 0.0)


def _http_date(value: str) -> datetime | None:
    try:
        moment = parsedate_to_datetime(value)
    except ValueError:
        return None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
