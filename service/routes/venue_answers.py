"""Stored venues in the words of the API."""

from __future__ import annotations

from dataclasses import asdict

from service.http.conditional import plan_etag
from service.runtime import Runtime
from service.schemas import VenueAnchorAnswer, VenueAnswer, VenuePlanAnswer, VenueSummary
from service.storage.records import VenueMember, VenueRecord


def venue_summary(record: VenueRecord) -> VenueSummary:
    """A venue as a listing has it."""
    return VenueSummary(
        id=record.id,
        revision=record.revision_id,
        name=record.name,
        anchor=None if record.anchor is None else VenueAnchorAnswer(**asdict(record.anchor)),
        plans=record.plans,
        created_at=record.created_at,
        updated_at=record.updated_at,
    )


def venue_representation(record: VenueRecord, runtime: Runtime) -> tuple[bytes, str]:
    """A venue as JSON, and the entity tag of that."""
    counts = runtime.store.venues.counts(record.id, *runtime.grids.model)
    answer = VenueAnswer(
        **venue_summary(record).model_dump(),
        revision_number=record.revision,
        plans_ready=counts.ready,
        plans_failed=counts.failed,
    )
    content = answer.model_dump_json().encode()
    return content, plan_etag(record.revision_id, content)


def plan_entries(members: list[VenueMember], runtime: Runtime) -> list[VenuePlanAnswer]:
    """Plans of a venue; one that is deleted at this moment is left out."""
    summaries = runtime.store.plans.summaries([member.plan_id for member in members])
    states = dict(zip([summary.id for summary in summaries], runtime.grids.states(summaries), strict=True))
    of_plan = {summary.id: summary for summary in summaries}
    return [
        VenuePlanAnswer(
            floorplan_id=member.plan_id,
            revision=of_plan[member.plan_id].revision_id,
            level=member.level,
            name=member.name or of_plan[member.plan_id].name,
            status=states[member.plan_id].status,
            progress=states[member.plan_id].progress,
            rooms=of_plan[member.plan_id].room_count,
            area_m2=of_plan[member.plan_id].area_m2,
        )
        for member in members
        if member.plan_id in of_plan
    ]
