"""Openings, holes, free-standing walls, types and ids of a plan: placement and validation."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_LIMITS, FloorPlan, PlanLimits, room_type_from_label
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.render.sampling import pose_grid, random_poses
from tests.strategies import plan_document, rectangle, seeds

# Two rooms of 4 x 3 m, separated by a wall of 20 cm.
ROOMS = plan_document(rectangle(4.0, 3.0), rectangle(4.0, 3.0, corner=(4.2, 0.0)))
DOOR = {"kind": "door", "line": [[4.1, 1.0], [4.1, 1.9]]}


def with_openings(*openings: Any, **extra: Any) -> FloorPlan:
    return FloorPlan.from_dict(ROOMS | {"openings": list(openings)} | extra)


def with_room(limits: PlanLimits = DEFAULT_LIMITS, **extra: Any) -> FloorPlan:
    document = plan_document(rectangle(4.0, 3.0))
    document["rooms"][0] |= extra
    return FloorPlan.from_dict(document, limits)


def refused(make: Any, *arguments: Any, **extra: Any) -> str:
    with pytest.raises(InvalidFloorPlanError) as caught:
        make(*arguments, **extra)
    return str(caught.value)


def test_opening_belongs_to_both_rooms_of_a_wall() -> None:
    plan = with_openings(DOOR)
    first, second = plan.opening_faces
    assert (first.room, first.behind, second.room, second.behind) == (0, 1, 1, 0)
    np.testing.assert_allclose(plan.rooms[0].wall_part(first.wall, first.start, first.end), [[4.0, 1.0], [4.0, 1.9]])
    np.testing.assert_allclose(plan.wall_table.exit_m[0][[0, 2]], [4.2, 4.2])
    assert plan.wall_table.opening_kind.tolist() == [1, 1]
    assert plan.warnings == ()
    chosen = with_openings(DOOR | {"rooms": ["room-2"]})
    assert [(face.room, face.behind) for face in chosen.opening_faces] == [(1, -1)]


@pytest.mark.parametrize("x_m", [4.0, 4.2, 3.9, 4.3])
def test_opening_near_a_wall_is_placed_on_it(x_m: float) -> None:
    plan = with_openings(DOOR | {"line": [[x_m, 1.0], [x_m, 1.9]]})
    assert [face.room for face in plan.opening_faces] == [0, 1]


def test_surveyed_coordinates_do_not_move_openings() -> None:
    polygons = [rectangle(4.0, 3.0, corner=corner) for corner in ((500_000.0, 5_300_000.0), (500_004.2, 5_300_000.0))]
    line = [[500_004.1, 5_300_001.0], [500_004.1, 5_300_001.9]]
    far = FloorPlan.from_dict(plan_document(*polygons) | {"openings": [{"kind": "door", "line": line}]})
    near = with_openings(DOOR)
    assert [(face.room, face.wall, face.behind) for face in far.opening_faces] == [
        (face.room, face.wall, face.behind) for face in near.opening_faces
    ]
    for far_face, near_face in zip(far.opening_faces, near.opening_faces, strict=True):
        assert (far_face.start, far_face.end) == pytest.approx((near_face.start, near_face.end), abs=1e-8)


def test_plan_sets_the_opening_tolerance() -> None:
    door = DOOR | {"line": [[4.0, 1.0], [4.0, 1.9]]}
    assert len(with_openings(door, opening_tolerance_m=0.1).opening_faces) == 1
    assert len(with_openings(door, opening_tolerance_m=0.2).opening_faces) == 2
    assert with_openings(DOOR, opening_tolerance_m=None).opening_tolerance_m == 0.35


def test_passage_to_two_rooms_is_split() -> None:
    polygons = [rectangle(4.0, 3.0), rectangle(1.9, 2.0, corner=(0.0, 3.1)), rectangle(2.0, 2.0, corner=(2.0, 3.1))]
    document = plan_document(*polygons) | {"openings": [{"kind": "passage", "line": [[0.5, 3.05], [3.5, 3.05]]}]}
    plan = FloorPlan.from_dict(document)
    parts = [(face.behind, round(4.0 * (face.end - face.start), 2)) for face in plan.opening_faces if face.room == 0]
    assert parts == [(1, 1.4), (-1, 0.1), (2, 1.5)]


def test_nearer_wall_gets_the_opening() -> None:
    """Test a recess as deep as a wall is thick."""
    recessed = [[0, 0], [4, 0], [4, 3], [3, 3], [3, 3.2], [1, 3.2], [1, 3], [0, 3]]
    document = plan_document(recessed) | {"openings": [{"kind": "window", "line": [[1.2, 3.2], [2.8, 3.2]]}]}
    assert [face.wall for face in FloorPlan.from_dict(document).opening_faces] == [4]


def test_openings_can_touch_but_not_overlap() -> None:
    assert len(with_openings(DOOR, {"kind": "window", "line": [[4.0, 1.9], [4.0, 2.5]]}).openings) == 2
    over = {"kind": "window", "line": [[4.0, 1.8], [4.0, 2.5]], "name": "hatch"}
    assert "opening 0 (door) and opening 1 (window 'hatch') overlap" in refused(with_openings, DOOR, over)
    # One above the other.
    light = {"kind": "window", "line": DOOR["line"], "sill_m": 2.1, "head_m": 2.4}
    assert len(with_openings(DOOR | {"head_m": 2.1}, light).openings) == 2
    assert "overlap" in refused(with_openings, DOOR | {"head_m": 2.2}, light)


def test_opening_on_no_wall_warns_or_fails() -> None:
    astray = {"kind": "window", "line": [[2.0, 1.0], [2.0, 2.0]], "name": "skylight"}
    assert with_openings(DOOR, astray).warnings == ("opening 1 (window 'skylight') is not on a wall",)
    assert "all openings are more than 0.35 m from every wall" in refused(with_openings, astray)
    # It crosses a wall.
    assert "from every wall" in refused(with_openings, {"kind": "door", "line": [[3.8, 1.0], [4.4, 1.0]]})


@pytest.mark.parametrize(
    ("opening", "reason"),
    [
        ("door", "opening 0 must be an object, not a string"),
        ({"kind": "gate", "line": DOOR["line"]}, "opening 0: the kind is 'gate'; it must be one of door, window"),
        ({"line": DOOR["line"]}, "the kind is null"),
        ({"kind": "door"}, "opening 0: the line must be two points"),
        ({"kind": "door", "line": [[0, 0], [0, 0]]}, "shorter than 0.01 m"),
        ({"kind": "door", "line": [[0, 0], [0, "1"]]}, "two numbers"),
        (DOOR | {"width_m": 1}, "opening 0: unknown key 'width_m'"),
        (DOOR | {"sill_m": -1}, "sill_m is -1; it must be between 0 and 20 m"),
        (DOOR | {"sill_m": 2, "head_m": 1.5}, "sill_m is 2 m; it must be below head_m (1.5 m)"),
        (DOOR | {"name": ""}, "name must be a non-empty string"),
        (DOOR | {"rooms": ["attic"]}, "rooms has 'attic', which is not the id of a room"),
        (DOOR | {"rooms": "room-1"}, "rooms must be a list, not a string"),
    ],
)
def test_bad_opening_error_names_its_number(opening: Any, reason: str) -> None:
    assert reason in refused(with_openings, opening)


def test_opening_kinds_default_to_those_that_occur() -> None:
    assert with_openings(DOOR).opening_kinds == {"door"}
    assert with_openings(DOOR, opening_kinds=["door", "window"]).opening_kinds == {"door", "window"}
    assert FloorPlan.from_dict(ROOMS).opening_kinds == frozenset()
    assert FloorPlan.from_dict(ROOMS | {"opening_kinds": ["window"]}).opening_kinds == {"window"}
    assert "'gate'" in refused(with_openings, DOOR, opening_kinds=["gate"])


def test_opening_trust_is_for_kinds_that_are_not_complete() -> None:
    assert with_openings(DOOR).opening_trust == {"door": 1.0}
    plan = with_openings(DOOR, opening_trust={"door": 0.7, "passage": 0})
    assert (plan.opening_trust, plan.opening_kinds, plan.warnings) == ({"door": 0.7}, frozenset(), ())
    assert plan.to_dict()["opening_trust"] == {"door": 0.7}
    assert FloorPlan.from_dict(plan.to_dict()).opening_trust == plan.opening_trust
    assert with_openings(DOOR, opening_trust={"window": 0.2}).opening_trust == {"door": 1.0, "window": 0.2}
    # Older clients add a kind to opening_kinds and send the trust back.
    corrected = with_openings(DOOR, opening_kinds=["door"], opening_trust={"door": 0.7})
    assert corrected.opening_trust == {"door": 1.0}
    assert corrected.warnings == (
        "opening_trust of 'door' is 0.7, but opening_kinds lists it: 1 is used; remove it from one of them",
    )


@pytest.mark.parametrize(
    ("trust", "fault"),
    [(["door"], "a list"), ({"gate": 1}, "gate"), ({"door": 1.5}, "1.5"), ({"door": "much"}, "door")],
)
def test_invalid_opening_trust_is_rejected(trust: Any, fault: str) -> None:
    message = refused(with_openings, DOOR, opening_trust=trust)
    assert "opening_trust" in message
    assert fault in message


@pytest.mark.parametrize("value", [0.0, 2.0, "0.3"])
def test_tolerance_out_of_range_is_refused(value: Any) -> None:
    assert "opening_tolerance_m" in refused(with_openings, DOOR, opening_tolerance_m=value)


def test_too_many_openings_are_refused() -> None:
    line = [[0.0, 0.5], [0.0, 0.6]]
    many = {"openings": [{"kind": "window", "line": line}] * 3}
    assert "3 openings; the limit is 2 (max_openings)" in refused(
        FloorPlan.from_dict, ROOMS | many, PlanLimits(max_openings=2)
    )
    windows = [{"kind": "window", "line": [[0.0, 0.5 * k], [0.0, 0.5 * k + 0.4]]} for k in range(6)]
    message = refused(FloorPlan.from_dict, ROOMS | {"openings": windows}, PlanLimits(max_openings_per_room=5))
    assert "room 'room 1': 6 openings on its walls; the limit is 5" in message
    message = refused(FloorPlan.from_dict, ROOMS | {"openings": windows}, PlanLimits(max_opening_faces=5))
    assert "the openings cover more than 5 parts of walls, the limit (PlanLimits.max_opening_faces)" in message


def test_opening_along_many_walls_is_refused() -> None:
    teeth = [
        [x, y]
        for k in range(40)
        for x, y in ([0, 0.01 * k], [9, 0.01 * k], [9, 0.01 * k + 0.005], [0, 0.01 * k + 0.005])
    ]
    combs = [[[-1, -1], *teeth[2 * k : 2 * k + 60], [-1, 3]] for k in range(3)]
    document = plan_document(*combs) | {"openings": [{"kind": "window", "line": [[1.0, 0.2], [3.0, 0.2]]}]}
    assert "walls; the limit is 32 (PlanLimits.max_walls_per_opening)" in refused(FloorPlan.from_dict, document)


def test_holes_are_not_floor_and_have_walls() -> None:
    plan = with_room(holes=[rectangle(1.0, 1.0, corner=(1.0, 1.0))])
    assert plan.rooms[0].area_m2 == pytest.approx(11.0)
    assert len(plan.rooms[0].walls_m) == 8
    assert plan.room_index_at(np.array([[1.5, 1.5], [0.5, 0.5]])).tolist() == [-1, 0]


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        ({"holes": [rectangle(1.0, 1.0, corner=(3.5, 1.0))]}, "hole 0 does not lie inside the polygon"),
        ({"holes": [rectangle(2.0, 2.0, corner=(0.5, 0.5)), rectangle(2.0, 2.0, corner=(1.0, 0.9))]}, "holes cross"),
        ({"holes": [[[1, 1], [2, 2], [2, 1], [1, 2]]]}, "hole 0 crosses itself"),
        ({"holes": [[[1, 1], [2, 2], [3, 3]]]}, "all vertices of hole 0 lie on one line"),
        ({"holes": rectangle(1.0, 1.0)}, "'hole 0' must be a list of at least three"),
        ({"holes": [rectangle(3.98, 2.98, corner=(0.01, 0.01))]}, "the area is"),
        ({"holes": "none"}, "holes must be a list, not a string"),
        ({"walls": [[[1, 1], [5, 1]]]}, "wall 0 leaves the room's floor"),
        ({"walls": [[[1, 1], [1, 1]]]}, "wall 0 is shorter than 0.01 m"),
        ({"walls": [[1, 1]]}, "wall 0: point 0 must be two numbers"),
        ({"holes": [rectangle(1.0, 1.0, corner=(1, 1))], "walls": [[[0.5, 1.5], [2.5, 1.5]]]}, "wall 0 leaves"),
        ({"type": "cave"}, "the type is 'cave'; it must be one of unknown, bedroom"),
        ({"type": None}, "the type is null"),
        ({"id": ""}, "the id must be a non-empty string"),
        ({"id": 7}, "the id must be a non-empty string"),
    ],
)
def test_bad_room_part_error_names_the_room(extra: dict[str, Any], reason: str) -> None:
    message = refused(with_room, **extra)
    assert reason in message
    assert "room 'room 1'" in message


def test_edges_of_holes_and_walls_count_as_vertices() -> None:
    extra = {"holes": [rectangle(1.0, 1.0, corner=(1.0, 1.0))], "walls": [[[3.0, 1.0], [3.0, 3.0]]]}
    assert len(with_room(PlanLimits(max_vertices_per_room=9), **extra).rooms[0].walls_m) == 9
    assert "9 vertices; the limit is 8" in refused(with_room, PlanLimits(max_vertices_per_room=8), **extra)


def test_poses_keep_the_margin_to_holes_and_inner_walls() -> None:
    plan = with_room(holes=[rectangle(1.0, 1.0, corner=(1.0, 1.0))], walls=[[[3.0, 0.0], [3.0, 3.0]]])
    for poses in (pose_grid(plan, 0.1), random_poses(plan, 500, np.random.default_rng(0))):
        x, y = poses.position_m.T
        assert not ((np.abs(x - 1.5) < 0.64) & (np.abs(y - 1.5) < 0.64)).any()
        assert (np.abs(x - 3.0) > 0.149).all()
        assert (x > 3.0).any()


def test_room_full_of_inner_walls_has_a_pose() -> None:
    plan = with_room(walls=[[[0.2 * k, 0.0], [0.2 * k, 3.0]] for k in range(1, 20)])
    position = pose_grid(plan, 1.0).position_m
    assert len(position) == 1
    assert abs(position[0, 0] % 0.2 - 0.1) < 0.06


def test_ids_from_names_are_unique() -> None:
    names = ["Bed room", "bed room!", "Küche", "bed-room-2", "???"]
    document = plan_document(*[rectangle(1.0, 1.0, corner=(2.0 * k, 0.0)) for k in range(5)])
    for room, name in zip(document["rooms"], names, strict=True):
        room["name"] = name
    document["rooms"][4]["id"] = "bed-room"
    ids = [room.id for room in FloorPlan.from_dict(document).rooms]
    assert ids == ["bed-room-2", "bed-room-3", "küche", "bed-room-2-2", "bed-room"]
    document["rooms"][0]["id"] = "bed-room"
    assert "2 rooms have the id 'bed-room'; ids must be unique" in refused(FloorPlan.from_dict, document)


def test_room_type_from_label() -> None:
    expected = {"Living room 2": "living", "master bedroom": "bedroom", "WC": "bathroom", "store room": "storage"}
    expected |= {"study": "office", "hall": "corridor", "undefined": "unknown", "": "unknown"}
    expected |= {"studio": "unknown", "photo studio": "unknown"}
    assert {label: room_type_from_label(label) for label in expected} == expected


@pytest.mark.parametrize(
    ("name", "types"),
    [
        ("Küche", "kitchen"), ("Chambre 2", "bedroom"), ("LivingRoom", "living"), ("Bad/WC", "bathroom"), ("X17", ""),
        ("Soveværelser", "bedroom"), ("Łazienka", "bathroom"), ("En-suite bathroom", "bathroom"), ("ET", "entrance"),
        ("洗面脱衣室", "bathroom"), ("Wohnküche", "living kitchen"), ("Wohn-/Essbereich", "living dining"),
        ("K/F", "kitchen living"), ("LDK 15.2", "living dining kitchen"), ("Kitchen & Dining Room", "kitchen dining"),
        ("Sala de jantar / cozinha", "dining kitchen"), ("Salon salle à manger", "living dining"),
        ("リビング・ダイニング", "living dining"), ("Bath / laundry", "bathroom laundry"), ("W/C", "bathroom"),
        ("Recámara 2", "bedroom"), ("Salon z aneksem", "living kitchen"), ("Bedroom and office", "bedroom office"),
        ("Bedroom closet", "bedroom"), ("Ruokailu", "dining"), ("OH+K", "kitchen living"), ("Great Room", "living"),
    ],
)  # fmt: skip
def test_name_of_a_room_gives_its_types(name: str, types: str) -> None:
    room = with_room(name=name).rooms[0]
    assert room.types == tuple(types.split())
    assert room.type == (types.split() or ["unknown"])[0]


def test_stated_types_replace_those_of_the_name() -> None:
    assert with_room(name="Kitchen", type="office").rooms[0].types == ("office",)
    several = with_room(name="Kitchen", types=["dining", "living", "dining"])
    assert several.rooms[0].types == ("dining", "living")
    assert FloorPlan.from_dict(several.to_dict()).rooms[0].types == ("dining", "living")
    assert with_room(name="Kitchen", types=[]).rooms[0].types == ()
    with pytest.raises(InvalidFloorPlanError, match="'bedroom', which types does not list"):
        with_room(type="bedroom", types=["kitchen"])
    with pytest.raises(InvalidFloorPlanError, match="unknown"):
        with_room(types=["unknown"])


def test_all_plan_fields_round_trip() -> None:
    document = ROOMS | {"openings": [DOOR | {"name": "front", "sill_m": 0.0, "head_m": 2.0, "rooms": ["room-1"]}]}
    document["rooms"][0] |= {
        "type": "kitchen",
        "holes": [rectangle(0.5, 0.5, corner=(1, 1))],
        "walls": [[[3, 0], [3, 1]]],
    }
    document |= {"camera_height_std_m": 0.05, "opening_kinds": ["window", "door"], "opening_tolerance_m": 0.25}
    plan = FloorPlan.from_dict(document)
    again = FloorPlan.from_json(json.dumps(plan.to_dict()))
    assert again.to_dict() == plan.to_dict()
    assert again.opening_faces == plan.opening_faces
    assert (again.opening_kinds, again.camera_height_std_m) == ({"door", "window"}, 0.05)
    for name, values in vars(plan.wall_table).items():
        np.testing.assert_array_equal(getattr(again.wall_table, name), values)
        assert not values.flags.writeable


@pytest.mark.parametrize("value", [-0.1, 2.5, "0.1", True])
def test_bad_camera_height_std_is_refused(value: Any) -> None:
    assert "camera_height_std_m" in refused(with_openings, DOOR, camera_height_std_m=value)


@settings(max_examples=10)
@given(seeds())
def test_synthetic_home_plan_has_its_openings(seed: int) -> None:
    home = generate_home(np.random.default_rng(seed))
    plan, kinds = home.plan, {"door_open": 1, "door_shut": 1, "window": 2, "opening": 3}
    faces = [(f.room, f.wall, f.behind, plan.openings[f.opening].code) for f in plan.opening_faces]
    assert sorted(faces) == sorted((o.room, o.wall, o.neighbour, kinds[o.kind]) for o in home.openings)
    assert plan.warnings == ()
    assert plan.opening_kinds == frozenset(OPENING_CLASSES[1:])
    assert all(room.type != "unknown" for room in plan.rooms)


class TestJson:
    def test_repeated_keys_and_numbers_with_thousands_of_digits_are_refused(self) -> None:
        text = json.dumps(ROOMS)[:-1] + ', "name": "other"}'
        assert "the key 'name' occurs twice" in refused(FloorPlan.from_json, text)
        message = refused(FloorPlan.from_json, '{"ceiling_height_m": ' + "9" * 5000 + "}")
        assert message == "a number has 5000 digits; the limit is 300"

    @pytest.mark.parametrize(
        ("value", "word"), [([], "a list"), ("x", "a string"), (None, "null"), (True, "true"), (1, "a number")]
    )
    def test_messages_use_json_types(self, value: Any, word: str) -> None:
        assert f"a plan must be an object, not {word}" in refused(FloorPlan.from_dict, value)


@pytest.mark.parametrize("types", [[], ["living"], ["living", "office"], None])
def test_types_survive_writing_beside_names_and_fixtures(types: list[str] | None) -> None:
    room = {"name": "Kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]]}
    stove = {"kind": "stove", "outline": [[1, 1], [1.6, 1], [1.6, 1.6], [1, 1.6]]}
    bed = {"kind": "bed", "outline": [[2, 1], [3, 1], [3, 2], [2, 2]]}
    document = {"rooms": [room if types is None else room | {"types": types}], "fixtures": [stove, bed]}
    plan = FloorPlan.from_dict(document)
    assert plan.rooms[0].types == (("kitchen", "bedroom") if types is None else tuple(types))
    assert plan.type_shares[0].sum() == pytest.approx(1.0)
    assert FloorPlan.from_dict(plan.to_dict()).rooms[0].types == plan.rooms[0].types
