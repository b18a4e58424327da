"""What comes back of a query from another process: an answer, or the error with all that its problem document says."""

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
    """An answer."""

    value: T


@dataclass(frozen=True)
class Failure:
    """An error that is meant for whoever asked.

    Errors are not sent as they are: pickling makes them anew of the text that they end with, which is seldom what
    their constructors take.
    """

    kind: type[LaLaLocError]
    text: tuple[Any, ...]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, error: LaLaLocError) -> Failure:
        """What an error says."""
        return cls(type(error), error.args, dict(error.__dict__))

    @property
    def error(self) -> LaLaLocError:
        """The same error."""
        error = self.kind.__new__(self.kind)
        error.args = self.text
        error.__dict__.update(self.attributes)
        return error


def telling_failures(
    method: Callable[Concatenate[S, P], Awaitable[T]],
) -> Callable[Concatenate[S, P], Coroutine[Any, Any, Success[T] | Failure]]:
    """A method of a replica that returns an outcome: what this one returns, or the `LaLaLocError` that it raises."""

    @wraps(method)
    async def told(self: S, *args: P.args, **kwargs: P.kwargs) -> Success[T] | Failure:
        try:
            return Success(await method(self, *args, **kwargs))
        except LaLaLocError as error:
            return Failure.of(error)

    return told
