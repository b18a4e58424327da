"""What methods keep of the plans they were last asked about."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from lalaloc_core.floorplan import FloorPlan

_Value = TypeVar("_Value")


class KeptPerPlan(Generic[_Value]):
    """The last few values made for a plan and a key; plans are compared by identity.

    Queries come scene by scene, and cameras of a scene often share a height: a few are enough.
    """

    def __init__(self, limit: int = 4) -> None:
        self._limit = limit
        # Numbers of objects are used again once they are gone, so the plan itself is kept as well.
        self._kept: OrderedDict[tuple[int, Hashable], tuple[FloorPlan, _Value]] = OrderedDict()

    def get(self, plan: FloorPlan, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """The value kept for a plan and a key, made now where there is none."""
        slot = (id(plan), key)
        if slot not in self._kept:
            self._kept[slot] = (plan, make())
            if len(self._kept) > self._limit:
                self._kept.popitem(last=False)
        return self._kept[slot][1]
