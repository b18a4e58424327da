"""What comes back of a query from another process: an answer, or the error with all that its problem document says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from lalaloc_core.errors import LaLaLocError

T = TypeVar("T")


@dataclass(frozen=True)
class Answered(Generic[T]):
    """An answer."""

    value: T


@dataclass(frozen=True)
class Refused:
    """An error that is meant for whoever asked.

    Errors are not sent as they are: pickling makes them anew of the text that they end with, which is seldom what
    their constructors take.
    """

    kind: type[LaLaLocError]
    text: tuple[Any, ...]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, error: LaLaLocError) -> Refused:
        """What an error says."""
        return cls(type(error), error.args, dict(error.__dict__))

    @property
    def error(self) -> LaLaLocError:
        """The same error."""
        error = self.kind.__new__(self.kind)
        error.args = self.text
        error.__dict__.update(self.attributes)
        return error
