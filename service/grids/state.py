"""How far a plan's own latent grid is, whichever replica computes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from service.grids.grid_jobs import GridJob
from service.schemas import PlanStatus
from service.storage.records import ComputedGrid


@dataclass(frozen=True)
class GridState:
    """How far a plan's own latent grid is; `poses` is None until it is computed."""

    status: PlanStatus
    progress: float
    poses: int | None
    reason: str | None = None

    @classmethod
    def after_upload(cls, prepared: ComputedGrid | None) -> Self:
        """That of a plan that was stored just now, with its grid or without."""
        return cls("preparing", 0.0, None) if prepared is None else cls("ready", 1.0, len(prepared.grid.poses))

    @classmethod
    def of(cls, failure: str | None, poses: int | None, remote: float | None, job: GridJob | None) -> Self:
        """That of a stored plan.

        Args:
            failure: why the grid could not be computed last time.
            poses: of the stored grid.
            remote: how far another replica is with it.
            job: the one that computes it here, or waits for that.
        """
        if poses is not None:
            return cls("ready", 1.0, poses)
        if failure is not None and job is None:
            return cls("failed", 0.0, None, failure)
        return cls("preparing", max(remote or 0.0, job.progress if job else 0.0), None)
