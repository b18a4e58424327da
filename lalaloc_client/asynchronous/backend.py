"""Waiting, locks and blocking calls for asyncio; `blocking/backend.py` has the same names for threads."""

from asyncio import Lock, Semaphore, sleep
from asyncio import to_thread as run_blocking
from collections.abc import Awaitable, Callable

__all__ = ["Fetch", "FetchLimit", "Lock", "Semaphore", "run_blocking", "sleep", "try_acquire"]

Fetch = Callable[[str], Awaitable[bytes]]
FetchLimit = Callable[[], Awaitable[int]]


async def try_acquire(slots: Semaphore) -> bool:
    """Take a slot without waiting; return whether one was free."""
    return not slots.locked() and await slots.acquire()
