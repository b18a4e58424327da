"""Stored venues as answers of the API."""

from __future__ import annotations

from dataclasses import asdict

from service.http.conditional import revision_etag
from service.runtime import Runtime
from service.schemas import VenueAnchorAnswer, VenueAnswer, VenuePlanAnswer, VenueSummary
from service.storage.records import VenueMember, VenueRecord


def venue_summary(record: VenueRecord) -> VenueSummary:
    """Return a venue as an item of a list."""
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
    """Return a venue as JSON, and its entity tag."""
    counts = runtime.venue_plans.counts(record.tenant, record.id)
    answer = VenueAnswer(
        **venue_summary(record).model_dump(),
        revision_number=record.revision,
        plans_ready=counts.ready,
        plans_failed=counts.failed,
    )
    content = answer.model_dump_json().encode()
    return content, revision_etag(record.revision_id, content)


def plan_entries(members: list[VenueMember], runtime: Runtime) -> list[VenuePlanAnswer]:
    """Return the plans of a venue; a plan that was just deleted is left out."""
    summaries = runtime.store.plans.summaries([member.plan_id for member in members])
    states = dict(zip([summary.id for summary in summaries], runtime.grids.states(summaries), strict=True))
    by_id = {summary.id: summary for summary in summaries}
    return [
        VenuePlanAnswer(
            floorplan_id=member.plan_id,
            revision=by_id[member.plan_id].revision_id,
            level=member.level,
            name=member.name or by_id[member.plan_id].name,
            status=states[member.plan_id].status,
            progress=states[member.plan_id].progress,
            rooms=by_id[member.plan_id].room_count,
            area_m2=by_id[member.plan_id].area_m2,
        )
        for member in members
        if member.plan_id in by_id
    ]
