"""Decision whether and when to repeat a request; clock and randomness are arguments."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum

_TRY_LATER = frozenset({429, 503})
_CONFLICT = 409


class Safety(Enum):
    """Effect of sending a request twice.

    Attributes:
        ANY: the same as sending it once: repeat it after any failure.
        UNSENT: another effect: repeat it only if the first attempt was certainly not carried out.
    """

    ANY = "any"
    UNSENT = "unsent"


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """Number of attempts and waits between them.

    Attributes:
        total_s: time after the start of the first attempt by which every wait must end.
        first_s: maximum wait before the second attempt; doubles with each attempt.
        longest_s: maximum wait, unless the service asks for more with Retry-After.
    """

    attempts: int = 6
    total_s: float = 60.0
    first_s: float = 0.25
    longest_s: float = 10.0

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise ValueError(f"attempts is {self.attempts}; it must be at least 1")
        for name in ("total_s", "first_s", "longest_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value}; it must be a finite, non-negative number of seconds")

    def wait_s(self, attempt: int, spent_s: float, after_s: float | None, chance: float) -> float | None:
        """Return the wait after a failed attempt, None after the last one.

        Attempts count from 1; `spent_s` is the time since the first began. `after_s`, the wait that the service asks
        for with Retry-After, is the minimum. `chance`, from 0 to 1, spreads clients that failed together.
        """
        if attempt >= self.attempts:
            return None
        backoff_s = min(self.first_s * 2.0 ** (attempt - 1), self.longest_s)
        wait_s = backoff_s * (0.5 + 0.5 * chance) if after_s is None else after_s + self.first_s * chance
        return wait_s if spent_s + wait_s <= self.total_s else None


def may_retry(safety: Safety, status: int | None, *, sent: bool, has_retry_after: bool = False) -> bool:
    """Return whether repeating a failed request is safe and can help.

    `safety` is the effect of sending the request twice; `status` is None without an answer; `sent` means that a part of
    the request may have reached the service.
    """
    if status is None:
        return safety is Safety.ANY or not sent
    # A conflict with Retry-After passes: the service still works on an earlier attempt of the same request.
    return status in _TRY_LATER or (status == _CONFLICT and has_retry_after)


def retry_after_s(value: str | None, date: str | None, now: datetime) -> float | None:
    """Return the seconds that a Retry-After header asks for, None if it cannot be read.

    `value` is a number of seconds or an HTTP date, counted from the answer's Date header so that the clocks need not
    agree, or from `now` without one.
    """
    if value is None:
        return None
    if value.strip().isdecimal():
        # The limit of nine digits keeps the number within the range of a float.
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
