"""Waiting, locks and blocking calls for threads; `asynchronous/backend.py` has the same names for asyncio."""

from collections.abc import Callable
from threading import Lock, Semaphore
from time import sleep
from typing import ParamSpec, TypeVar

__all__ = ["Fetch", "FetchLimit", "Lock", "Semaphore", "run_blocking", "sleep", "try_acquire"]

P = ParamSpec("P")
T = TypeVar("T")

Fetch = Callable[[str], bytes]
FetchLimit = Callable[[], int]


def run_blocking(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that blocks."""
    return function(*args, **kwargs)


def try_acquire(slots: Semaphore) -> bool:
    """Take a slot without waiting; return whether one was free."""
    return slots.acquire(blocking=False)
