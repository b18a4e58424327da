"""Both clients with venues of the production app."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lalaloc_client import ConflictError, InvalidError, NotFoundError, VenueAnchor, VenuePlan
from tests.importers.test_roomplan import two_stories
from tests.service.conftest import FLAT

ANCHOR = VenueAnchor(51.7546, -1.2545, altitude_m=61.0, north_deg=12.5)


def test_venue_is_stored_changed_and_deleted(service: Any) -> None:
    plans = [service.upload_floorplan(FLAT | {"name": f"Flat {number}"}).id for number in range(3)]
    members = [VenuePlan(plan, level) for level, plan in enumerate(plans[:2])]
    made = service.make_venue(members, name="12 Mill Lane", anchor=ANCHOR)
    assert (made.name, made.anchor, made.plans, made.plans_ready) == ("12 Mill Lane", ANCHOR, 2, 2)
    assert service.venue(made.id) == made
    assert made.id in [venue.id for venue in service.venues("mill lane", page_size=1)]
    listed = service.venue_plans(made.id, page_size=1)
    found = [(plan.floorplan_id, plan.level, plan.name) for plan in listed]
    assert found == [(plans[0], 0.0, "Flat 0"), (plans[1], 1.0, "Flat 1")]
    assert [plan.floorplan_id for plan in service.venue_plans(made.id, level=1)] == [plans[1]]
    changed = service.change_venue(
        made.id, plans=[VenuePlan(plans[2], 5, "attic")], remove=[plans[0]], if_match=made.etag
    )
    assert (changed.plans, changed.anchor) == (2, ANCHOR)
    with pytest.raises(ConflictError):
        service.change_venue(made.id, name="x", if_match=made.etag)
    assert service.change_venue(made.id, anchor=None).anchor is None
    replaced = service.replace_venue(made.id, [VenuePlan(plans[0])], name="new")
    assert (replaced.name, replaced.plans, replaced.revision_number) == ("new", 1, 4)
    service.delete_venue(made.id)
    with pytest.raises(NotFoundError):
        service.venue(made.id)
    assert service.floorplan(plans[0]).status == "ready"


def test_file_of_several_levels_becomes_a_venue(service: Any, tmp_path: Path) -> None:
    file = tmp_path / "12 Mill Lane.json"
    file.write_bytes(two_stories())
    venue = service.upload_venue(file)
    assert [(plan.name, plan.level) for plan in service.venue_plans(venue.id)] == [
        ("12 Mill Lane – story 0", 0.0),
        ("12 Mill Lane – story 1", 1.0),
    ]
    options = {"ceiling_height_m": 2.4}
    named = service.upload_venue(two_stories(), name="Home", options=options, idempotency_key="a")
    assert named == service.upload_venue(two_stories(), name="Home", options=options, idempotency_key="a")
    assert (named.name, service.upload_venue(FLAT).name) == ("Home", "venue")
    with pytest.raises(InvalidError, match="unknown part"):
        service.upload_venue(file, options={"level": "1"})


def test_files_of_plans_extend_a_venue(service: Any) -> None:
    def homes(*numbers: int) -> dict[str, Any]:
        return {"plans": [{**FLAT, "name": f"home {number}", "level": number} for number in numbers]}

    venue = service.upload_venue(homes(0))
    extended = service.extend_venue(venue.id, homes(2, 1), idempotency_key="b", if_match=venue.etag)
    assert (extended.plans, extended.revision_number) == (3, 2)
    assert service.extend_venue(venue.id, homes(2, 1), idempotency_key="b", if_match=venue.etag) == extended
    assert [(plan.name, plan.level) for plan in service.venue_plans(venue.id)] == [
        (f"home {number}", number) for number in range(3)
    ]
    with pytest.raises(ConflictError):
        service.extend_venue(venue.id, homes(3), if_match=venue.etag)
    with pytest.raises(InvalidError, match="level 'home 4'"):
        service.extend_venue(venue.id, {"plans": [FLAT, {"name": "home 4", "rooms": []}]})
    assert service.venue(venue.id) == extended


def test_sphere_is_localised_in_a_venue(service: Any, sphere: bytes) -> None:
    plans = [service.upload_floorplan(FLAT).id for _ in range(2)]
    venue = service.make_venue([VenuePlan(plan, 3) for plan in plans])
    answer = service.localise_in_venue(venue.id, sphere, refine="none", top_k=3)
    assert (answer.venue_id, answer.level) == (venue.id, 3.0)
    assert answer.floorplan_id in plans
    assert {plan.floorplan_id for plan in answer.plans} == set(plans)
    assert {candidate.floorplan_id for candidate in answer.candidates} <= set(plans)
    alone = service.localise(plans[0], sphere, refine="none")
    assert (alone.venue_id, alone.level, alone.plans) == (None, None, None)


def test_venue_query_takes_options(service: Any, sphere: bytes) -> None:
    plans = [service.upload_floorplan(FLAT).id for _ in range(2)]
    venue = service.make_venue([VenuePlan(plan, level) for level, plan in enumerate(plans)])
    answer = service.localise_in_venue(venue.id, sphere, level=1, rooms=["kitchen"], strict=True, refine="none")
    assert (answer.floorplan_id, answer.level, answer.room) == (plans[1], 1.0, "kitchen")
    with pytest.raises(InvalidError, match="no floor plan of the venue is on level 5"):
        service.localise_in_venue(venue.id, sphere, level=5)


def test_malformed_venue_id_is_rejected(service: Any) -> None:
    with pytest.raises(ValueError, match=r"venue_id is '\.\./floorplans'"):
        service.delete_venue("../floorplans")
    with pytest.raises(InvalidError, match="changes nothing"):
        service.change_venue(service.make_venue([]).id)
