"""A bounded memory of what was used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

_Value = TypeVar("_Value")


class Recent(Generic[_Value]):
    """Keeps values up to a total weight; what was not asked for the longest goes first.

    Args:
        limit: total weight that is kept.
        weight: of a value; by default every value weighs 1.
    """

    def __init__(self, limit: int, weight: Callable[[_Value], int] | None = None) -> None:
        self._limit = limit
        self._weight = weight or _one
        self._total = 0
        self._values: OrderedDict[Hashable, _Value] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """The value of a key, made where it is not kept; nothing is kept of a `make` that raises."""
        if key not in self._values:
            value = make()
            self._values[key] = value
            self._total += self._weight(value)
            while self._total > self._limit and len(self._values) > 1:
                self._total -= self._weight(self._values.popitem(last=False)[1])
        self._values.move_to_end(key)
        return self._values[key]


def _one(_: object) -> int:
    return 1
