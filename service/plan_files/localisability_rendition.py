"""Photographs of a plan that will be found: the prediction as JSON, and maps of it."""

from __future__ import annotations

import json

from lalaloc_core.conditions import Condition
from lalaloc_core.draw.localisability import localisability_svg
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.localisability.predicted_localisability import localisability
from lalaloc_core.localise.localisability.reports import report_of
from service.schemas import ModelAnswer
from service.schemas.localisability import LocalisabilityAnswer
from service.stored_plan import RenditionJob


def plan_localisability(plan: FloorPlan, job: RenditionJob, *, coarse: bool = False) -> bytes:
    """Return the `LocalisabilityAnswer` of a plan as JSON."""
    assert job.bundle is not None, "the prediction needs the model"
    answer = LocalisabilityAnswer(
        floorplan_id=job.stored.id,
        revision=job.stored.revision_id,
        model=ModelAnswer.of(job.bundle),
        **report_of(plan, localisability(plan, job.bundle.manifest, coarse=coarse), coarse=coarse),
    )
    return answer.model_dump_json().encode()


def localisability_map(plan: FloorPlan, report: bytes, condition: Condition) -> bytes:
    """Return the drawing of a `LocalisabilityAnswer` of the plan as SVG."""
    return localisability_svg(plan, json.loads(report), condition).encode()
