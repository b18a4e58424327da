"""Cost of a fit by chance: the cost of a picture at places of other homes.

A photograph of a dim or cluttered room has a high cost at its own place, and a photograph of another building a low
cost at some place, so the cost alone does not separate the two. The cost relative to that at a cohort of unrelated
places does; speaker verification normalises its scores in this way (Auckenthaler, Carey and Lloyd-Thomas, 2000). The
cohort consists of poses of training homes. It is made when a model is calibrated, and is part of its bundle.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.bundle import COHORT, Bundle, MatchingWeights
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match.coarse_pass import coarse_costs
from lalaloc_core.localise.match.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.match.pose_grid import SPHERE_AZIMUTHS, VIEW_AZIMUTHS, BinnedLayouts, Layouts, layouts_at
from lalaloc_core.localise.query import Query
from lalaloc_core.render.sampling import pose_grid

SIZE = 2048
# Step of the grids that poses are drawn from.
_STEP_M = 0.5
# Number of poses, the best by the coarse pass, that are compared in full, and of the best of these, whose mean cost is
# that of a fit by chance: the cost of the very best varies too much.
_COMPARED, _BEST = 64, 8
# Cost of the best pictures, added to both sides of ratios.
_MIN_COST = 0.01


@dataclass(frozen=True, eq=False)
class Cohort:
    """Poses of other homes.

    `log_profile` is in half precision; `kind` has codes as in `conventions.OPENING_CLASSES`.
    """

    log_profile: Float[np.ndarray, "n w"]
    kind: UInt8[np.ndarray, "n w"]

    @cached_property
    def layouts(self) -> Layouts:
        """Layouts of the poses, all in one room."""
        return Layouts(self.log_profile, np.zeros(len(self.kind), dtype=np.int64), self.kind)

    @cached_property
    def binned(self) -> BinnedLayouts:
        """Layouts as the coarse pass compares them with spheres."""
        return BinnedLayouts.of(self.layouts, SPHERE_AZIMUTHS)

    @cached_property
    def binned_for_views(self) -> BinnedLayouts:
        """Layouts as the coarse pass compares them with views."""
        return BinnedLayouts.of(self.layouts, VIEW_AZIMUTHS)

    def to_bytes(self) -> bytes:
        """Return the content of the bundle's file."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, log_profile=self.log_profile, kind=self.kind)
        return buffer.getvalue()

    @classmethod
    def of_bundle(cls, bundle: Bundle) -> Cohort | None:
        """Read the cohort of a bundle; None if it has none."""
        if COHORT not in bundle.manifest.files:
            return None
        try:
            with np.load(io.BytesIO(bundle.read(COHORT)), allow_pickle=False) as arrays:
                found = cls(arrays["log_profile"], arrays["kind"])
        except (ValueError, KeyError, OSError) as error:
            raise BundleError(f"bundle '{bundle.folder}': '{COHORT}' is not a valid cohort: {error}") from error
        columns = bundle.manifest.profile_columns
        if found.log_profile.shape[1:] != (columns,) or found.kind.shape != found.log_profile.shape:
            raise BundleError(
                f"'{COHORT}' has {found.log_profile.shape[1:]} columns, the model {columns}: calibrate again"
            )
        return found


def cohort_of(plans: Iterable[FloorPlan], columns: int, seed: int) -> Cohort:
    """Draw `SIZE` random poses of some plans, or all if there are fewer."""
    profiles, kinds = [], []
    for plan in plans:
        poses = pose_grid(plan, _STEP_M)
        layouts = layouts_at(plan, poses, np.zeros(len(poses)), columns)
        profiles.append(layouts.log_profile.astype(np.float16))
        walls = np.zeros(layouts.log_profile.shape, np.uint8)
        kinds.append(walls if layouts.kind is None else layouts.kind)
    log_profile, kind = np.concatenate(profiles), np.concatenate(kinds)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(log_profile))[:SIZE])
    return Cohort(log_profile[chosen], kind[chosen])


def cost_by_chance(
    cohort: Cohort | None,
    plan: FloorPlan,
    query: Query,
    reach_m: float,
    weights: MatchingWeights,
    config: MatchingConfig,
    *,
    room: int = 0,
) -> float | None:
    """Return the cost of a fit by chance; None without a cohort, or if poses are compared by their latents.

    The plan's trust in openings is that of one of its rooms; `reach_m` is the reach of the poses of its grid.
    """
    if cohort is None or not config.compares_profiles(query):
        return None
    # A fit by chance does not depend on what is specific to one room.
    general = replace(config, use_ceiling=False, use_room_type=False, use_see_through=False)
    matching_cost = MatchingCost(plan, query, reach_m, weights, general)
    binned = cohort.binned_for_views if query.is_view else cohort.binned
    layouts = replace(cohort.layouts, room_index=np.full(len(cohort.layouts), room))
    coarse = coarse_costs(binned, matching_cost, layouts.room_index, usual_height=True)
    hypothesis = coarse.argmin(axis=1)
    pose = np.argsort(coarse[np.arange(len(coarse)), hypothesis], kind="stable")[:_COMPARED]
    by_chance, _ = matching_cost.pairs(layouts, pose, hypothesis[pose])
    return float(np.sort(by_chance)[:_BEST].mean())


def log_cost_to_chance(cost: float, by_chance: float | None) -> float:
    """Return the log of a cost over that of a fit by chance; below 0 it fits better, 0 if that is unknown."""
    return 0.0 if by_chance is None else math.log((cost + _MIN_COST) / (by_chance + _MIN_COST))
