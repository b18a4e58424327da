"""From what the search found to what is drawn of it."""

from __future__ import annotations

from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.draw.answer import DrawnAnswer, DrawnCandidate
from lalaloc_core.draw.heat import posterior_map
from lalaloc_core.draw.plan import Marker
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import ConfidenceModel
from lalaloc_core.localise.covariance import pose_uncertainty
from lalaloc_core.localise.pipeline import Localisation, panorama_heading
from lalaloc_core.localise.poses import Candidate, PoseGrid, Query
from lalaloc_core.localise.probability_map import probability_map


def drawn_answer(
    plan: FloorPlan,
    grid: PoseGrid,
    found: Localisation,
    model: ConfidenceModel | None,
    heading_source: str,
    truth: Marker | None = None,
) -> DrawnAnswer:
    """What is drawn of what the search found.

    Args:
        model: turns the posterior into probabilities; None leaves them out.
        heading_source: where the heading came from, in a word or two.
    """
    fits = None if model is None else found.fit_probability(model)
    best, *others = found.candidates
    spread = None
    if model is not None and best.information is not None:
        spread = pose_uncertainty(best.information, plan.rooms[best.room_index], model)
    covariance = None
    if spread is not None:
        (xx, xy), (_, yy) = spread.position_m2.tolist()
        covariance = (xx, xy, yy)
    rivals = [
        DrawnCandidate(
            one.x_m,
            one.y_m,
            _heading_deg(found.query, one),
            plan.rooms[one.room_index].name,
            None if fits is None else fits * share,
        )
        for one, share in zip(others, found.posterior.candidate[1:], strict=True)
    ]
    return DrawnAnswer(
        plan=plan,
        camera=Marker(
            x_m=best.x_m, y_m=best.y_m, heading_deg=_heading_deg(found.query, best), covariance_m2=covariance
        ),
        room_index=best.room_index,
        camera_height_m=found.camera_height_m,
        heading_source="searched for" if found.heading_contradicted else heading_source,
        confidence=None if model is None else found.confidence(model),
        rivals=tuple(rivals),
        heat=posterior_map(plan, probability_map(plan, grid.poses, found.posterior), grid.step_m),
        truth=truth,
    )


def _heading_deg(query: Query, candidate: Candidate) -> float:
    return heading_to_degrees(panorama_heading(query, candidate))
