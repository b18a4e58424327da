"""Ground of a query: the plan, or the plans of a venue side by side, that a photograph is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.answers import documents as answers
from lalaloc_core.localise.answers.documents import Placed
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import NO_HINTS, Candidate, HintName, Hints
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.tracking.tracked_plans import LeftOut
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.prototypes import share_searched
from service.schemas import PlanProbability
from service.storage.records import PlanRecord
from service.venues.venue_hints import VenueHints
from service.venues.venue_search import LoadedPlans

# Plans whose probabilities differ by less than this are a tie.
_TIED = 1e-9


@dataclass(frozen=True, kw_only=True)
class PlacedCandidate(Placed):
    """A candidate in the frame of its stored plan."""

    plan_id: str
    revision_id: str
    anchor: Anchor | None
    level: float | None


@dataclass(frozen=True, eq=False)
class Ground(answers.Ground):
    """Places that a photograph is compared with.

    Attributes:
        merged: the plans side by side; None for one plan outside of venues.
        venue_plans: the plans of the venue; None for one plan outside of venues.
        venue_hints: hints of the request about the venue; None outside of venues.
    """

    records: Sequence[PlanRecord]
    anchors: Sequence[Anchor | None]
    levels: Sequence[float | None]
    hints: Hints = NO_HINTS
    warnings: Sequence[str] = ()
    merged: MergedPlans | None = None
    venue_plans: LoadedPlans | None = None
    venue_hints: VenueHints | None = None

    @classmethod
    def of_plan(cls, record: PlanRecord, grid: PoseGrid, hints: Hints = NO_HINTS) -> Ground:
        """Return the ground of one plan."""
        return cls(record.plan, grid, [record], [record.plan.anchor], [None], hints)

    @classmethod
    def of_venue(cls, loaded: LoadedPlans, stated: VenueHints, camera_height_m: float) -> Ground:
        """Return the ground of plans of a venue for a camera height (m)."""
        plans = [record.plan for record in loaded.records]
        merged = MergedPlans.of(plans, loaded.grids, camera_height_m)
        partly = loaded.log_mass is not None
        hints = stated.in_merged_plans(loaded.rows, plans, merged, loaded.hint_shares, partly=partly)
        return cls(
            plan=merged.plan,
            grid=merged.grid,
            records=loaded.records,
            anchors=[plan.anchor_within(stated.anchor) for plan in plans],
            levels=[row.level for row in loaded.rows],
            hints=hints,
            warnings=loaded.warnings,
            merged=merged,
            venue_plans=loaded,
            venue_hints=stated,
        )

    @property
    def left_out(self) -> LeftOut | None:
        """Plans of the venue that are not searched; None if there are none."""
        if self.venue_plans is None or self.venue_plans.log_mass is None:
            return None
        return LeftOut(self.venue_plans.area_share, self.venue_plans.log_mass, np.array(self.venue_plans.numbers))

    def place(self, candidate: Candidate) -> PlacedCandidate:
        """Return the plan of a candidate, and the candidate in that plan's frame."""
        number, own = (0, candidate) if self.merged is None else self.merged.in_own_plan(candidate)
        record = self.records[number]
        return PlacedCandidate(
            record.plan,
            own,
            plan_id=record.id,
            revision_id=record.revision_id,
            anchor=self.anchors[number],
            level=self.levels[number],
        )

    @property
    def rooms_known(self) -> bool:
        """True if rooms need not be asked for; plans of a venue have rooms of the same names."""
        return self.hints.rooms is not None or self.merged is not None

    def share(self, found: Localisation) -> float:
        """Return the probability that the camera is in a searched plan."""
        if self.venue_plans is None or self.venue_plans.log_mass is None:
            return 1.0
        return share_searched(self.venue_plans.log_mass, np.array(self.venue_plans.numbers), self._share_by_plan(found))

    def plan_probabilities(self, found: Localisation, fit: float | None) -> list[PlanProbability]:
        """Return the plans of a venue, most probable first.

        `fit` is the probability that the photograph is of a searched plan; None where it is unknown.
        """
        assert self.venue_plans is not None
        share, rows = self._share_by_plan(found), self.venue_plans.rows
        return [
            PlanProbability(
                floorplan_id=rows[number].plan_id,
                level=rows[number].level,
                name=rows[number].name,
                probability=None if fit is None else min(fit * float(share[number]), 1.0),
            )
            for number in _by_probability(share, np.array(self.venue_plans.numbers))
        ]

    def hint_warnings(self, found: Localisation) -> list[str]:
        """Return a warning for every hint that the photograph contradicts, followed or not."""
        return [self._hint_warning(name, found) for name in found.hints_missed]

    def _share_by_plan(self, found: Localisation) -> Float[np.ndarray, "m"]:
        assert self.merged is not None
        return self.merged.by_plan(found.posterior.pose)

    def _hint_warning(self, name: HintName, found: Localisation) -> str:
        answer, hints = found.candidates[0], self.hints
        place = self.place(answer)
        if name == "near":
            assert hints.near is not None
            (distance_m,) = hints.near.distance_m(answer.position_m[None], np.array([answer.room_index]))
            stated = f"near is within {hints.near.radius_m:g} m of {hints.near}"
            instead = f"the answer is {distance_m:.1f} m from there"
        elif name == "rooms":
            if self.venue_hints is None:
                rooms, within = [self.plan.rooms[index].id for index in sorted(hints.rooms or ())], ""
            else:
                rooms, within = self.venue_hints.rooms, f" of floor plan '{place.plan_id}'"
            stated = f"rooms is {', '.join(map(repr, rooms))}"
            instead = f"the answer lies in room '{place.plan.rooms[place.candidate.room_index].id}'{within}"
        else:
            assert self.venue_hints is not None
            stated = f"level is {self.venue_hints.level:g}"
            instead = f"the answer is on level {place.level:g}"
        followed = "the answer follows it because strict is set" if hints.strict else instead
        return f"{stated}, which the photograph contradicts: {followed}"


def _by_probability(share: Float[np.ndarray, "m"], number: Int[np.ndarray, "m"]) -> list[int]:
    """Return the order of falling probability; copies of a plan, equal up to rounding, are ordered by `number`."""
    order = np.argsort(-share, kind="stable")
    tie = np.concatenate([[0], np.cumsum(-np.diff(share[order]) >= _TIED)])
    return order[np.lexsort((number[order], tie))].tolist()
