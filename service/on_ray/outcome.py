"""Outcome of a query in another process: an answer, or an error with all its attributes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from lalaloc_core.errors import LaLaLocError

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True)
class Success(Generic[T]):
    """Answer."""

    value: T


@dataclass(frozen=True)
class Failure:
    """Error for the caller.

    Exceptions are not sent themselves: unpickling calls their constructors with the message, which most of them do not
    accept.
    """

    kind: type[LaLaLocError]
    text: tuple[Any, ...]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, error: LaLaLocError) -> Failure:
        """Return the failure for an error."""
        return cls(type(error), error.args, dict(error.__dict__))

    @property
    def error(self) -> LaLaLocError:
        """The original error."""
        error = self.kind.__new__(self.kind)
        error.args = self.text
        error.__dict__.update(self.attributes)
        return error


def returning_failures(
    method: Callable[Concatenate[S, P], Awaitable[T]],
) -> Callable[Concatenate[S, P], Coroutine[Any, Any, Success[T] | Failure]]:
    """Make a replica's method return its answer or the `LaLaLocError` that it raises as an outcome."""

    @wraps(method)
    async def wrapper(self: S, *args: P.args, **kwargs: P.kwargs) -> Success[T] | Failure:
        try:
            return Success(await method(self, *args, **kwargs))
        except LaLaLocError as error:
            return Failure.of(error)

    return wrapper
