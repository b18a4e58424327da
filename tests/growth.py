"""How the time for some work grows with its input."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

# Twice the input may take so many times as long: linear growth, and what a busy machine adds to it.
_MAX_RATIO = 2.5
# Work that is over sooner is repeated: clocks are not that fine.
_MIN_S = 0.02
_TRIES = 12


def assert_no_worse_than_linear(work_of: Callable[[int], Callable[[], object]], size: int) -> None:
    """Check that twice the input takes at most two and a half times as long, in time of this thread's processor.

    Args:
        work_of: makes the work for a size of input; the time for that does not count.
        size: of the smaller input.
    """
    small, large = work_of(size), work_of(2 * size)
    repeats = 1
    while _time_of(small, repeats) < _MIN_S:
        repeats *= 2
    small_s = large_s = math.inf
    for _ in range(_TRIES):
        # Others on the machine only ever make it slower: the fastest of some tries counts.
        small_s, large_s = min(small_s, _time_of(small, repeats)), min(large_s, _time_of(large, repeats))
        if large_s <= _MAX_RATIO * small_s:
            return
    raise AssertionError(f"twice the input takes {large_s / small_s:.1f} times as long")


def _time_of(work: Callable[[], object], repeats: int) -> float:
    begin = time.thread_time()
    for _ in range(repeats):
        work()
    return time.thread_time() - begin
