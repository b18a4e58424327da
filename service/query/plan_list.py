"""Rows of the plans of a venue, with the columns and sums that each query needs of them."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from sqlalchemy import Row

# Odd factor of the ids of grids in their keys.
_FACTOR = np.uint64(0x9E3779B97F4A7C15)


class PlanList(list[Row[Any]]):
    """Rows of plans as `Venues.searchable_plans` returns them; never changed after it was filled."""

    @cached_property
    def ready(self) -> PlanList:
        """The plans with a pose grid."""
        found = [row for row in self if row.grid_id is not None]
        return self if len(found) == len(self) else PlanList(found)

    @cached_property
    def failed(self) -> int:
        """Number of plans whose pose grid failed."""
        return sum(row.grid_id is None and row.failure is not None for row in self)

    @cached_property
    def poses(self) -> Int[np.ndarray, "p"]:
        """Number of grid poses of each plan that is ready."""
        return np.array([row.poses for row in self.ready], np.int64)

    @cached_property
    def area_m2(self) -> Float[np.ndarray, "p"]:
        """Area (m²) of each plan."""
        return np.array([row.area_m2 for row in self])

    @cached_property
    def most_common_height(self) -> tuple[float, float | None, bool]:
        """Camera height (m) and its standard deviation (m) of most plans; True if all plans have them."""
        heights = Counter((row.camera_height_m, row.camera_height_std_m) for row in self)
        (height_m, std_m), _ = heights.most_common(1)[0]
        return height_m, std_m, len(heights) == 1

    @cached_property
    def keys(self) -> UInt64[np.ndarray, "p"]:
        """Key of each plan's pose grid; equal keys of different grids are as rare as equal hashes of 64 bits."""
        digests = np.frombuffer(bytes.fromhex("".join(row.grid_sha256 for row in self)), np.uint64)
        return digests[::4] + np.array([row.grid_id for row in self], np.uint64) * _FACTOR

    def chosen(self, kept: Bool[np.ndarray, "p"]) -> PlanList:
        """Return the plans that are kept; this list if all are."""
        return self if kept.all() else PlanList([self[k] for k in np.flatnonzero(kept).tolist()])

    @classmethod
    def of(cls, rows: list[Row[Any]]) -> Self:
        """Return rows of plans, each plan once, in order."""
        return cls({row.plan_id: row for row in rows}.values())
