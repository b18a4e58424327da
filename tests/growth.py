"""Assertion that the time of a computation is linear in its input."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable

# Largest ratio of times for twice the input: between 2 (linear) and 4 (quadratic), since a busy machine adds noise.
_MAX_RATIO = 3.0
# Shorter work is repeated, since clocks are coarse.
_MIN_S = 0.02
_TRIES = 30


def assert_no_worse_than_linear(prepare: Callable[[int], Callable[[], object]], size: int) -> None:
    """Check that twice the input takes at most three times as long, in CPU time of this thread.

    Args:
        prepare: returns the work for an input size; its own time does not count.
        size: size of the smaller input.
    """
    small, large = prepare(size), prepare(2 * size)
    repeats = 1
    while _seconds(small, repeats) < _MIN_S:
        repeats *= 2
    small_s = large_s = math.inf
    for _ in range(_TRIES):
        # Other processes can only slow the work down, so the fastest try counts.
        small_s, large_s = min(small_s, _seconds(small, repeats)), min(large_s, _seconds(large, repeats))
        if large_s <= _MAX_RATIO * small_s:
            return
    raise AssertionError(f"twice the input takes {large_s / small_s:.1f} times as long")


def _seconds(work: Callable[[], object], repeats: int) -> float:
    # A collection takes time for all objects of the process, not for those of the work.
    gc.disable()
    try:
        begin = time.thread_time()
        for _ in range(repeats):
            work()
        return time.thread_time() - begin
    finally:
        gc.enable()
