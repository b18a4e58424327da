"""Searches as generators: they yield refinement jobs, which callers run in this process or another."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")
FoundT = TypeVar("FoundT")


def next_step(steps: Generator[JobT, ResultT | None, FoundT], result: ResultT | None) -> JobT | FoundT:
    """Continue a search; return its next job or its result.

    Args:
        steps: the search.
        result: result of the last job; None at first, and if there is no result (in time).
    """
    try:
        return steps.send(result)
    except StopIteration as done:
        return done.value


def run_steps(
    steps: Generator[JobT, ResultT | None, FoundT], refiner: Callable[[JobT], ResultT | None] | None
) -> FoundT:
    """Run a whole search in this process.

    Args:
        steps: the search.
        refiner: runs a job; returns None if it has no result (in time). It can be None for searches without jobs.
    """
    result: ResultT | None = None
    while True:
        try:
            job = steps.send(result)
        except StopIteration as done:
            return done.value
        assert refiner is not None
        result = refiner(job)
