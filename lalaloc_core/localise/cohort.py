"""What fits a picture by chance: how well it fits places of homes that it cannot be of.

A photograph of a dim or cluttered room fits its own place badly, and one of another building fits some place quite
well, so how badly the best place fits does not tell the two apart. How badly it fits *in units of what a cohort of
strangers gives* does; speaker verification normalises its scores so (Auckenthaler, Carey and Lloyd-Thomas, 2000). The
cohort are poses of training homes. It is made when a model is calibrated, and travels in its bundle.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.binned_layouts import BinnedLayouts
from lalaloc_core.localise.bundle import COHORT, Bundle, MatchingWeights
from lalaloc_core.localise.coarse_pass import coarse_costs
from lalaloc_core.localise.layouts import Layouts, layouts_at
from lalaloc_core.localise.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.poses import Query
from lalaloc_core.render.sampling import pose_grid

SIZE = 2048
# Of the grids that poses are drawn from.
_STEP_M = 0.5
# So many that are the best at first look are compared in full. What fits by chance costs what the mean of so many of
# these does, as the very best is a matter of luck.
_COMPARED, _BEST = 64, 8
# Costs are compared above this: it is what the best of pictures costs.
_MIN_COST = 0.01


@dataclass(frozen=True, eq=False)
class Cohort:
    """Poses of strangers.

    Attributes:
        log_profile: (n, w) log wall profiles (m), in half precision.
        kind: (n, w) codes of what is met, as in `conventions.OPENING_CLASSES`.
    """

    log_profile: Float[np.ndarray, "n w"]
    kind: UInt8[np.ndarray, "n w"]

    @cached_property
    def layouts(self) -> Layouts:
        """The poses as evidence is weighed of them, all as of one room."""
        return Layouts(self.log_profile, np.zeros(len(self.kind), dtype=np.int64), self.kind)

    @cached_property
    def binned(self) -> BinnedLayouts:
        """What the first look sees of them."""
        return BinnedLayouts.of(self.layouts)

    def to_bytes(self) -> bytes:
        """A file of it."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, log_profile=self.log_profile, kind=self.kind)
        return buffer.getvalue()

    @classmethod
    def of_bundle(cls, bundle: Bundle) -> Cohort | None:
        """The cohort of a model; None where it has none.

        Raises:
            BundleError: the file was altered, or does not hold one.
        """
        if COHORT not in bundle.manifest.files:
            return None
        try:
            with np.load(io.BytesIO(bundle.read(COHORT)), allow_pickle=False) as arrays:
                found = cls(arrays["log_profile"], arrays["kind"])
        except (ValueError, KeyError, OSError) as error:
            raise BundleError(f"bundle '{bundle.folder}': '{COHORT}' holds no cohort: {error}") from error
        columns = bundle.manifest.profile_columns
        if found.log_profile.shape[1:] != (columns,) or found.kind.shape != found.log_profile.shape:
            raise BundleError(f"'{COHORT}' is of {found.log_profile.shape[1:]} columns, the model has {columns}")
        return found


def cohort_of(plans: Iterable[FloorPlan], columns: int, seed: int) -> Cohort:
    """`SIZE` poses of some plans, fewer if they have not so many, drawn at random."""
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
) -> float | None:
    """What a plan costs that fits a picture by chance.

    Args:
        plan: says which openings count.
        reach_m: how far the poses of the plan's grid may lie from the camera.

    Returns:
        None without a cohort, or where poses are compared by their latents.
    """
    if cohort is None or not config.compares_profiles(query):
        return None
    # A fit by chance does not depend on what is specific to one room.
    general = replace(config, use_ceiling=False, use_room_type=False, use_see_through=False)
    matching_cost = MatchingCost(plan, query, reach_m, weights, general)
    coarse = coarse_costs(cohort.binned, matching_cost, cohort.layouts.room_index)
    hypothesis = coarse.argmin(axis=1)
    pose = np.argsort(coarse[np.arange(len(coarse)), hypothesis], kind="stable")[:_COMPARED]
    by_chance, _ = matching_cost.pairs(cohort.layouts, pose, hypothesis[pose])
    return float(np.sort(by_chance)[:_BEST].mean())


def log_cost_to_chance(cost: float, by_chance: float | None) -> float:
    """Log of a cost in units of what fits by chance: below 0 it fits better. 0 where that is not known."""
    return 0.0 if by_chance is None else math.log((cost + _MIN_COST) / (by_chance + _MIN_COST))
