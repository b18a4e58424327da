"""Searches that stop where poses are to be optimised, so that who asks may have that done elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")
FoundT = TypeVar("FoundT")


def next_step(steps: Generator[JobT, ResultT | None, FoundT], result: ResultT | None) -> JobT | FoundT:
    """Go on with a search: what is to be refined next, or what was found.

    Args:
        result: of the job that the last step gave; None at first, and where nobody could refine it (in time).
    """
    try:
        return steps.send(result)
    except StopIteration as done:
        return done.value


def run_steps(
    steps: Generator[JobT, ResultT | None, FoundT], refiner: Callable[[JobT], ResultT | None] | None
) -> FoundT:
    """Go through a whole search here.

    Args:
        refiner: optimises poses, None where it cannot (in time); may be missing for searches that ask for none.
    """
    result: ResultT | None = None
    while True:
        try:
            job = steps.send(result)
        except StopIteration as done:
            return done.value
        assert refiner is not None
        result = refiner(job)
