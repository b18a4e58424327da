"""How the time for some work grows with its input."""

from __future__ import annotations

import time
from collections.abc import Callable

# Twice the input may take so many times as long: linear growth, and what a busy machine adds to it.
_MOST = 2.5
# Work that is over sooner is repeated: clocks are not that fine.
_LEAST_S = 0.02
_TRIES = 4


def assert_no_worse_than_linear(work_of: Callable[[int], Callable[[], object]], size: int) -> None:
    """Check that twice the input takes at most two and a half times as long, in time of this thread's processor.

    Args:
        work_of: makes the work for a size of input; the time for that does not count.
        size: of the smaller input.
    """
    small, large = work_of(size), work_of(2 * size)
    ratios: list[float] = []
    for _ in range(_TRIES):
        repeats = 1
        while (small_s := _time_of(small, repeats)) < _LEAST_S:
            repeats *= 2
        ratios.append(_time_of(large, repeats) / small_s)
        if ratios[-1] <= _MOST:
            return
    raise AssertionError(f"twice the input takes {', '.join(f'{ratio:.1f}' for ratio in ratios)} times as long")


def _time_of(work: Callable[[], object], repeats: int) -> float:
    begin = time.thread_time()
    for _ in range(repeats):
        work()
    return time.thread_time() - begin
