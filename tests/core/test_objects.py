"""Objects in photographs of real rooms, which tell the type of the room, with the shipped model."""

from __future__ import annotations

import json
import math
import pickle
import re
import struct
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.errors import InvalidFeaturesError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Confidence
from lalaloc_core.localise.belief.confidence import is_outside, reason_for
from lalaloc_core.localise.encode.features import FeatureEncoder, read_features
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.view_encoder import OBJECT_OUTPUTS, objects_of_views, outside_odds
from lalaloc_core.localise.match import MatchingConfig, PlaceCost
from lalaloc_core.localise.match.matching_cost import MatchingCost
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, PredictedRoomType, Query, SeenObject, SeenObjects
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.photograph import Photograph
from tests.core.questions import perfect_query
from tests.core.shipped import bundle, encoder, level_view
from tests.strategies import present

# Bed of the hotel room: azimuth from the sphere's centre.
BED_DEG = 90.0
HEIGHT = CameraHeight(1.5)


def view(heading_deg: float, width: int = 640, height: int = 480) -> Photograph:
    """Return a level view of the hotel room."""
    return level_view("real/hotel_room", heading_deg, 0.0, width=width, height=height)


def query(*views: tuple[Photograph, float]) -> Query:
    (first, _), *others = views
    return encoder().query(first, None, HEIGHT, others=others)


def plan(*types: str) -> FloorPlan:
    """Return a plan of equal rooms."""
    rooms = [
        {"name": f"room {k}", "type": kind, "polygon": [[5 * k, 0], [5 * k + 4, 0], [5 * k + 4, 3], [5 * k, 3]]}
        for k, kind in enumerate(types)
    ]
    return FloorPlan.from_dict({"rooms": rooms})


@pytest.mark.parametrize("headings_deg", [(150.0,), (BED_DEG, 150.0, 210.0)])
@pytest.mark.parametrize(
    ("turns", "expected"),
    [(0, []), (1, ["on its side: turned by 90° to the right"]), (2, ["upside down: turned by 180°"])],
)
def test_photographs_that_do_not_lie_upright_are_named(
    headings_deg: tuple[float, ...], turns: int, expected: list[str]
) -> None:
    upright = [view(heading_deg) for heading_deg in headings_deg]
    lying = [replace(each, thumbnail=np.rot90(present(each.thumbnail), turns).copy()) for each in upright]
    warnings = pickle.loads(pickle.dumps(query(*((replace(each, is_upright=False), 0.0) for each in lying)))).warnings
    assert [re.sub(".* may lie (.*), the objects.*", r"\1", text) for text in warnings] == expected
    assert query(*((each, 0.0) for each in lying)).warnings == ()


def test_bed_is_seen_where_it_stands() -> None:
    shown = present(query((view(BED_DEG - 15.0), 0.0)).objects)
    beds = [seen for seen in shown.objects if seen.name in ("four-poster bed", "quilt", "pillows", "couch")]
    assert beds
    assert math.degrees(beds[0].azimuth) == pytest.approx(15.0, abs=25.0)
    assert next(iter(shown.room_type.shares())) == "bedroom"


def test_low_confidence_of_a_photograph_without_household_objects_has_its_reason() -> None:
    room = present(query((view(BED_DEG), 0.0)).objects)
    assert room.outside < 0.0
    assert outside_odds(np.full(63, 0.0005)) > 3.0
    outside = replace(room, outside=3.0)
    assert [is_outside(Confidence(fit, 0.3, 0.3, ()), outside) for fit in (0.9, 0.99)] == [True, False]
    assert "façade or a garden" in str(reason_for(0.3, 0.2, outside, is_warned=True))
    assert reason_for(0.8, 0.2, outside, is_warned=False) is None
    assert reason_for(0.05, 0.2, room, is_warned=True) is None
    assert "several places look alike" in str(reason_for(0.05, 0.2, room, is_warned=False))


def test_idle_core_takes_over_objects_with_equal_answers() -> None:
    asked = view(BED_DEG), 0.0
    alone = query(asked)
    features = present(encoder().with_features(asked[0]).features)
    parts: list[str] = []

    class Helper(ThreadPoolExecutor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            parts.append(fn.__name__)
            return super().submit(fn, *args, **kwargs)

    with Helper(1) as helper:
        encoder().use_helper(lambda: helper)
        try:
            beside = query(asked)
            same = present(encoder().with_features(asked[0]).features)
        finally:
            encoder().use_helper(lambda: None)
    assert parts == ["_object_outputs", "_object_outputs"]
    assert features.outputs.keys() == same.outputs.keys() >= set(OBJECT_OUTPUTS)
    for name, values in features.outputs.items():
        np.testing.assert_array_equal(same.outputs[name], values)
    assert present(beside.objects).objects == present(alone.objects).objects


def test_room_of_the_seen_type_wins_among_equal_rooms() -> None:
    types = ("kitchen", "bathroom", "bedroom", "unknown")
    equal = plan(*types)
    asked = query((view(BED_DEG), 0.0))
    grid = build_grid(equal, encoder().layouts, step_m=0.5, camera_height_m=1.5, latents=False)
    assert types[localise(equal, grid, encoder().layouts, asked, refine="none").candidates[0].room_index] == "bedroom"


def test_objects_cost_rooms_of_other_types_and_not_those_without_one() -> None:
    asked = query((view(BED_DEG), 0.0))
    cost = MatchingCost(plan("bedroom", "bathroom", "unknown"), asked, 0.1, MatchingWeights(), MatchingConfig())
    bedroom, bathroom, unknown = cost.room_costs[0]
    share = present(asked.objects).room_type.shares()["bedroom"]
    assert bedroom < unknown < bathroom
    # A log likelihood: the odds against a room without a type, over the temperature.
    ratio = 0.03 + 0.97 * share * (len(ROOM_TYPES) - 1)
    assert unknown - bedroom == pytest.approx(math.log(ratio) / MatchingWeights().temperature, rel=1e-3)


def test_detector_finds_more_in_albums() -> None:
    manifest, photograph = present(bundle().manifest.objects), view(BED_DEG - 15.0)
    alone = present(query((photograph, 0.0)).objects)
    kept = encoder().with_features(photograph)
    probability = present(kept.features).outputs["object_probability"]
    bed = len(manifest.names) - manifest.detected + manifest.names[-manifest.detected :].index("bed")
    assert 0.2 < probability[bed] <= manifest.detected_weight
    assert math.degrees(present(kept.features).outputs["object_azimuth"][bed]) == pytest.approx(15.0, abs=25.0)
    found = present(query((kept, 0.0)).objects)
    assert found.room_type.shares()["bedroom"] > alone.room_type.shares()["bedroom"] + 0.1
    assert found.outside == pytest.approx(alone.outside, abs=1e-6)
    azimuth = np.zeros(len(manifest.names))
    # Objects of one kind of room are not independent: together they tell no more than one that is there for certain.
    present_all = np.where([name in ("microwave", "oven", "refrigerator") for name in manifest.names], 0.6, 0.0)
    many = objects_of_views(manifest, [(present_all, azimuth)]).room_type.log_probability
    assert many[ROOM_TYPES.index("kitchen")] - many[ROOM_TYPES.index("bathroom")] < 2 * math.log(15 / 0.02) + 1e-6


def test_views_of_one_spot_share_their_objects() -> None:
    bed, wall = view(BED_DEG), view(0.0)
    alone = present(query((bed, 0.0)).objects)
    both = present(query((wall, 0.0), (bed, math.radians(BED_DEG))).objects)
    turned = {seen.name: seen.azimuth for seen in both.objects}
    for seen in alone.objects:
        assert turned[seen.name] == pytest.approx(seen.azimuth + math.radians(BED_DEG), abs=1e-6)
    shares = alone.room_type.shares()["bedroom"], both.room_type.shares()["bedroom"]
    assert shares[0] > shares[1] > 1.0 / len(ROOM_TYPES)


def test_photograph_without_recognised_objects_tells_no_type() -> None:
    manifest = present(bundle().manifest.objects)
    azimuth = np.zeros(len(manifest.names))
    # What the classifier gives every object in any photograph.
    noise = np.full(len(manifest.names), manifest.floor)
    noise[-manifest.detected :] = 0.0
    alike = objects_of_views(manifest, [(noise, azimuth)]).room_type.log_probability[1:]
    assert np.ptp(alike) < 1e-9
    sure = np.where(np.array(manifest.names) == "stove", 0.5, noise)
    log = objects_of_views(manifest, [(sure, azimuth)]).room_type.log_probability
    ratio = math.exp(log[ROOM_TYPES.index("kitchen")] - log[ROOM_TYPES.index("bathroom")])
    # By the other half of the probability, nothing was seen.
    assert ratio == pytest.approx((0.51 + 0.49 * 15) / 0.51, rel=1e-6)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640), (1280, 320), (200, 900)])
def test_thumbnails_have_a_bounded_size(width: int, height: int) -> None:
    rows, columns = present(view(BED_DEG, width, height).thumbnail).shape[:2]
    assert rows % 32 == columns % 32 == 0
    assert 0.7 < rows * columns / (320 * 256) < 1.3
    assert columns / rows == pytest.approx(width / height, rel=0.2)


def test_features_carry_objects_and_files_of_version_1_are_read() -> None:
    photograph = view(BED_DEG)
    content = FeatureEncoder(bundle(), threads=1).features(photograph)
    expected, found = (present(query((read, 0.0)).objects) for read in (photograph, read_features(content, bundle())))
    assert [seen.name for seen in found.objects] == [seen.name for seen in expected.objects]
    for seen, other in zip(found.objects, expected.objects, strict=True):
        assert (seen.azimuth, seen.probability) == pytest.approx((other.azimuth, other.probability))
    arrays = 2 * 4 * len(present(bundle().manifest.objects).names)
    first = content[:4] + struct.pack("<H", 1) + content[6:-arrays]
    assert query((read_features(first, bundle()), 0.0)).objects is None
    with pytest.raises(InvalidFeaturesError, match="bytes"):
        read_features(content[:4] + struct.pack("<H", 1) + content[6:], bundle())


def test_features_with_impossible_objects_are_refused() -> None:
    content = FeatureEncoder(bundle(), threads=1).features(view(BED_DEG))
    with pytest.raises(InvalidFeaturesError, match="object_azimuth"):
        read_features(content[:-4] + np.float32(9.0).tobytes(), bundle())


def test_manifest_states_objects_and_types() -> None:
    objects = json.loads(bundle().manifest.to_json())["objects"]
    assert len(objects["names"]) == len(objects["shares"])
    kitchen = objects["shares"][objects["names"].index("stove")]
    assert ROOM_TYPES[int(np.argmax(kitchen))] == "kitchen"


def furnished(*fixtures: tuple[str, float, float]) -> FloorPlan:
    """Return a plan of four equal rooms without types, 5 m apart, with fixtures of 0.6 m (kind, x, y)."""
    document = plan("unknown", "unknown", "unknown", "unknown").to_dict()
    for room in document["rooms"]:
        room["types"] = []
    for kind, x, y in fixtures:
        outline = [[x, y], [x + 0.6, y], [x + 0.6, y + 0.6], [x, y + 0.6]]
        document.setdefault("fixtures", []).append({"kind": kind, "outline": outline})
    return FloorPlan.from_dict(document)


def test_room_that_draws_the_seen_bed_wins_among_equal_rooms() -> None:
    asked = query((view(BED_DEG), 0.0))
    for kind, expected in (("bed", 2), ("stove", None)):
        drawn = furnished((kind, 11.7, 2.2))
        grid = build_grid(drawn, encoder().layouts, step_m=0.5, camera_height_m=1.5, latents=False)
        found = localise(drawn, grid, encoder().layouts, asked, refine="none")
        by_room = np.bincount(grid.poses.room_index, found.posterior.pose)
        if expected is None:
            # Kinds that the photograph does not show, and kinds that the plan draws nowhere, tell nothing.
            np.testing.assert_allclose(by_room, 0.25, atol=1e-3)
        else:
            assert found.candidates[0].room_index == expected
            assert by_room[expected] > 1.2 * by_room[0]


def seen_from_the_middle(drawn: FloorPlan, *objects: SeenObject) -> Query:
    """Return the query of a camera in the middle of the first room, which sees objects."""
    found = perfect_query(encoder(), drawn, (2.0, 1.5), hypotheses=4)
    unknown = PredictedRoomType(np.full(len(ROOM_TYPES), -math.log(len(ROOM_TYPES))), np.full(len(ROOM_TYPES), 1 / 16))
    return replace(found, objects=SeenObjects(unknown, objects))


def test_stove_ahead_and_the_stove_that_is_drawn_tell_the_heading() -> None:
    # East of the middle: the camera looks along +x, or the stove is 90 degrees to its right.
    drawn = furnished(("stove", 3.4, 1.2))
    grid = build_grid(drawn, encoder().layouts, step_m=0.5, camera_height_m=1.5, latents=False)
    for azimuth_deg, expected_deg in ((0.0, 90.0), (90.0, 0.0)):
        asked = seen_from_the_middle(drawn, SeenObject("stove", 0.9, math.radians(azimuth_deg)))
        cost = present(PlaceCost.of(drawn, asked, NO_HINTS, 1.0, np.array([[2.0, 1.5], [7.0, 1.5]]), np.array([0, 1])))
        best = int(cost.of_poses(np.array([0]))[0].argmin())
        assert math.degrees(asked.roll[best]) == pytest.approx(expected_deg)
        # In a room without the stove all headings cost the same.
        (lowest,) = cost.of_pairs(np.array([0]), np.array([best]))
        elsewhere = cost.of_pairs(np.array([1, 1]), np.array([0, best]))
        assert elsewhere[0] == elsewhere[1] > lowest + 0.5
        assert lowest >= 0.0
        found = localise(drawn, grid, encoder().layouts, asked, refine="none")
        assert found.candidates[0].room_index == 0
        assert found.candidates[0].place_cost < elsewhere[0] / encoder().manifest.evidence.temperature


def test_fixtures_of_merged_plans_stay_in_their_plans() -> None:
    plans = [furnished(("stove", 3.4, 1.2)), furnished(("bed", 0.2, 0.2), ("stove", 8.4, 1.2))]
    grids = [build_grid(each, encoder().layouts, step_m=1.0, camera_height_m=1.5, latents=False) for each in plans]
    merged = MergedPlans.of(plans, grids, 1.5).plan
    assert sorted(merged.fixtures_by_kind) == ["bed", "stove"]
    np.testing.assert_array_equal(merged.fixtures_by_kind["stove"].room_index, [0, 5])


def test_rooms_and_plans_full_of_fixtures_tell_nothing() -> None:
    def cost(*fixtures: tuple[str, float, float]) -> np.ndarray:
        drawn = furnished(*fixtures)
        asked = seen_from_the_middle(drawn, SeenObject("washbasin", 0.9, 0.0))
        found = PlaceCost.of(drawn, asked, NO_HINTS, 1.0, np.array([[2.0, 1.5], [7.0, 1.5]]), np.array([0, 1]))
        return np.zeros((2, 4)) if found is None else found.of_poses(np.arange(2))

    washroom = [("basin", 0.2 + 0.2 * k, 2.0) for k in range(13)]
    basins = cost(*washroom)
    # The washroom tells the room and no direction.
    assert np.ptp(basins[0]) == 0.0
    assert basins[0, 0] < basins[1, 0]
    assert not cost(*(washroom * 39)).any()
    # All kinds that are seen count together.
    many = [("stove", 5.2 + 0.2 * k, 2.0) for k in range(13)] * 38
    drawn = furnished(*many, *washroom)
    seen = SeenObject("washbasin", 0.9, 0.0), SeenObject("stove", 0.9, 0.0)
    for objects, tells in ((seen[:1], True), (seen, False)):
        asked = seen_from_the_middle(drawn, *objects)
        found = PlaceCost.of(drawn, asked, NO_HINTS, 1.0, np.array([[2.0, 1.5]]), np.array([0]))
        assert (found is not None) == tells
