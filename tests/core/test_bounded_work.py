"""Bounded work for adversarial plans and pictures: limits, and linear time."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from PIL import Image

from lalaloc_core.errors import InvalidFloorPlanError, InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan, PlanLimits
from lalaloc_core.floorplan import rooms as room_checks
from lalaloc_core.floorplan.rooms import interior_point
from lalaloc_core.photograph.file_segments import check_segments
from lalaloc_core.photograph.photo_sphere import read_photo_sphere
from lalaloc_core.photograph.spheres import read_sphere
from lalaloc_core.render.sampling import pose_grid
from lalaloc_core.render.sweep import profiles_at
from tests.growth import assert_no_worse_than_linear
from tests.painted import picture_file, png_chunk
from tests.strategies import plan_document, plan_of, plans, rectangle, spiral


def comb(corners: int, *, upright: bool, shift_m: float) -> list[list[float]]:
    """Return a comb of 20 m with thin teeth; two combs, one rotated, cross at every pair of teeth."""
    teeth = corners // 4 - 1
    step = 20.0 / teeth
    spine = [[-1.0, 0.0], [-1.0, 21.0]]
    edge = [
        [x, y]
        for k in range(teeth)[::-1]
        for x, y in ([0, k * step + 0.4 * step], [20, k * step + 0.4 * step], [20, k * step], [0, k * step])
    ]
    ring = np.array(spine + edge) + shift_m
    return (ring if upright else ring[:, ::-1]).tolist()


def crossing_combs(rooms: int, corners: int = 200) -> dict[str, Any]:
    return plan_document(*[comb(corners, upright=k % 2 == 0, shift_m=0.01 * k) for k in range(rooms)])


def slivers(count: int) -> dict[str, Any]:
    """Return diagonal rooms of 5 cm across a square of 200 m."""
    return plan_document(*[[[k, 0], [k + 200, 200], [k + 200.05, 200], [k + 0.05, 0]] for k in range(count)])


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the number of pairs that each query of a spatial index finds."""
    found: list[int] = []

    class CountingTree(shapely.STRtree):
        def query(self, *arguments: Any, **options: Any) -> np.ndarray:
            pairs = super().query(*arguments, **options)
            found.append(pairs.shape[-1])
            return pairs

    monkeypatch.setattr(shapely, "STRtree", CountingTree)
    return found


def rows_of_rooms(rooms: int) -> dict[str, Any]:
    """Return rooms of 3 m in rows of 16, each with a door to the next."""
    places = [(3.0 * (k % 16), 3.0 * (k // 16)) for k in range(rooms)]
    document = plan_document(*[rectangle(2.9, 2.9, corner=place) for place in places])
    document["openings"] = [{"kind": "door", "line": [[x + 2.95, y + 1.0], [x + 2.95, y + 1.9]]} for x, y in places]
    return document


def lie_on_each_other(rooms: int) -> dict[str, Any]:
    return plan_document(*[rectangle(4.0, 4.0, corner=(1e-4 * k, 0.0)) for k in range(rooms)])


@pytest.mark.parametrize("shape", [rows_of_rooms, lie_on_each_other])
def test_comparisons_grow_linearly(shape: Any, compared: list[int]) -> None:
    counts = []
    for rooms in (256, 512):
        compared.clear()
        FloorPlan.from_dict(shape(rooms))
        counts.append(sum(compared))
    assert 0 < counts[1] <= 2.1 * counts[0]


@pytest.mark.parametrize("rooms", [256, 512, 1024])
def test_comparisons_of_long_openings_are_limited(rooms: int, compared: list[int]) -> None:
    document = rows_of_rooms(rooms)
    document["openings"] = [{"kind": "door", "line": [[0.01 * k, 0], [48, 3 * rooms / 16]]} for k in range(2 * rooms)]
    with pytest.raises(InvalidFloorPlanError, match=r"near more than 20000 walls in total, the limit \(PlanLimits\."):
        FloorPlan.from_dict(document, PlanLimits(max_opening_pairs=20_000))
    # Openings are compared in small batches.
    assert sum(compared) < 40_000


def test_long_opening_is_compared_with_the_walls_along_it(compared: list[int]) -> None:
    document = rows_of_rooms(256)
    document["openings"] = [{"kind": "passage", "line": [[0, 0], [48, 48]]}, document["openings"][0]]
    FloorPlan.from_dict(document)
    # The walls of all 256 rooms lie in the box of the diagonal.
    assert max(compared) < 256


def test_crossing_combs_stay_within_the_work_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the total size of intersected pairs is limited, independent of the number of rooms."""
    intersection = Mock(wraps=shapely.intersection)
    monkeypatch.setattr(room_checks.shapely, "intersection", intersection)
    monkeypatch.setattr(room_checks, "_MAX_OVERLAPS", 10**6)
    spent = []
    for rooms in (8, 16):
        intersection.reset_mock()
        plan = FloorPlan.from_dict(crossing_combs(rooms))
        assert plan.warnings[-1] == "more rooms may overlap; the remaining pairs were not checked"
        sizes = [[len(room.exterior.coords) for room in call.args] for call in intersection.call_args_list]
        spent.append(sum(map(math.prod, sizes)))
    assert 0 < spent[1] <= 1.5 * spent[0]


def test_simple_rooms_are_checked_beside_combs(monkeypatch: pytest.MonkeyPatch) -> None:
    document = crossing_combs(12)
    for name, x_m in (("left", 50.0), ("right", 51.0)):
        document["rooms"].append({"name": name, "polygon": rectangle(2.0, 2.0, corner=(x_m, 0.0))})
    monkeypatch.setattr(room_checks, "_MAX_WORK", 1000)
    assert "rooms 'left' and 'right' overlap by 2.00 m²" in FloorPlan.from_dict(document).warnings


def test_stored_plan_skips_the_overlap_search(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = FloorPlan.from_dict(plan_document(rectangle(3.0, 3.0), rectangle(3.0, 3.0, corner=(2.0, 0.0))))
    text = json.dumps(plan.to_dict())
    assert FloorPlan.from_stored(text, None).warnings == plan.warnings
    monkeypatch.setattr("lalaloc_core.floorplan.plan_document.overlap_warnings", pytest.fail)
    again = FloorPlan.from_stored(text, plan.warnings)
    assert again.warnings == plan.warnings
    assert again.to_dict() == plan.to_dict()


def test_stored_plan_ignores_limits() -> None:
    far = plan_document(rectangle(4.0, 3.0, corner=(1e8, 0.0)))
    with pytest.raises(InvalidFloorPlanError, match=r"at most 10000000 m from .* \(PlanLimits\.max_coordinate_m\)"):
        FloorPlan.from_dict(far)
    assert len(FloorPlan.from_stored(json.dumps(far), []).rooms) == 1
    low = {**far, "camera_height_m": 0.05}
    assert FloorPlan.from_stored(json.dumps(low), []).camera_height_m == 0.05


def test_bounding_box_area_is_limited() -> None:
    message = "the bounding boxes of all rooms cover 120030 m²; the limit is 100000 m² (max_bounds_area_m2)"
    with pytest.raises(InvalidFloorPlanError) as caught:
        FloorPlan.from_dict(slivers(3), PlanLimits(max_bounds_area_m2=100_000.0))
    assert str(caught.value) == message
    FloorPlan.from_dict(slivers(2), PlanLimits(max_bounds_area_m2=100_000.0))


def test_grid_in_slivers_needs_bounded_memory() -> None:
    plans = {count: FloorPlan.from_dict(slivers(count)) for count in (4, 8)}
    assert_no_worse_than_linear(lambda count: lambda: pose_grid(plans[count], 0.5), 4)


def test_lattice_in_parts_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = FloorPlan.from_dict(plan_document(rectangle(7.3, 5.1), [[10, 0], [19, 2], [15, 9]]))
    whole = pose_grid(plan, 0.1)
    monkeypatch.setattr("lalaloc_core.render.sampling._LATTICE_POINTS", 17)
    pieces = pose_grid(plan, 0.1)
    np.testing.assert_array_equal(pieces.position_m, whole.position_m)
    np.testing.assert_array_equal(pieces.room_index, whole.room_index)


@pytest.mark.parametrize("shape", [spiral, lambda corners: comb(corners, upright=True, shift_m=0.0)])
def test_room_validation_takes_linear_time(shape: Any) -> None:
    def work_of(corners: int) -> Any:
        document = plan_document(shape(corners))
        return lambda: FloorPlan.from_dict(document, PlanLimits(max_vertices_per_room=10_000))

    assert_no_worse_than_linear(work_of, 400)


def test_coordinates_are_exact_up_to_the_limit() -> None:
    near = FloorPlan.from_dict(plan_document(rectangle(4.0, 3.0)))
    far = FloorPlan.from_dict(plan_document(rectangle(4.0, 3.0, corner=(9_999_990.0, -9_999_990.0))))
    assert far.area_m2 == pytest.approx(near.area_m2, abs=1e-6)
    assert math.isclose(far.rooms[0].walls_m[0, 2] - far.rooms[0].walls_m[0, 0], 4.0, abs_tol=1e-8)


@pytest.mark.parametrize("offset_m", [1e5, -9.9e6])
def test_far_plans_keep_precision_in_single(offset_m: float) -> None:
    offsets_m = (0.0, offset_m)
    plans = [FloorPlan.from_dict(plan_document(rectangle(4.0, 3.0, corner=(x, x)))) for x in offsets_m]
    near, far = (
        profiles_at(plan, np.array([[x + 1.3, x + 1.1]]), np.array([0]), np.zeros(1), 32, np.float32)
        for plan, x in zip(plans, offsets_m, strict=True)
    )
    np.testing.assert_allclose(far, near, atol=1e-5)


@settings(max_examples=40)
@given(plans())
def test_interior_point_is_far_from_walls(plan: FloorPlan) -> None:
    for room in plan.rooms:
        (x, y), distance_m = interior_point(room.shape)
        assert room.shape.buffer(1e-9).contains(shapely.Point(x, y))
        assert distance_m == pytest.approx(room.shape.boundary.distance(shapely.Point(x, y)))
        assert distance_m > 0.9 * shapely.maximum_inscribed_circle(room.shape, 0.01).length


def test_square_and_sliver_have_an_interior_point() -> None:
    (x, y), distance_m = interior_point(shapely.Polygon(rectangle(4.0, 4.0)))
    assert (x, y, distance_m) == pytest.approx((2.0, 2.0, 2.0), abs=0.01)
    sliver = shapely.Polygon([(0.0, 0.0), (0.008, 0.0), (265.0, 290.0), (264.992, 290.0)])
    (x, y), distance_m = interior_point(sliver)
    assert sliver.contains(shapely.Point(x, y))
    assert 0.0 < distance_m < 0.004


def test_interior_point_takes_linear_time() -> None:
    def find(corners: int) -> Callable[[], object]:
        room = plan_of(spiral(corners)).rooms[0]
        return lambda: interior_point(room.shape)

    assert_no_worse_than_linear(find, 240)


_PACKET = 60_000
_GPANO = b"http://ns.google.com/photos/1.0/panorama/"


_TEXTS = {
    "escaped quotes": lambda size: '"' + '\\"' * size,
    "backslashes": lambda size: '"' + "\\" * size,
    "quotes": lambda size: '"' * size,
    "lists": lambda size: "[" * size,
    "objects": lambda size: "{" * size + "}" * size,
    "digits": lambda size: "9" * size,
    "decimals": lambda size: "[0." + "9" * size + "]",
    "keys": lambda size: "{" + ",".join(f'"{k}":0' for k in range(size // 4)) + "}",
    "rooms": lambda size: '{"rooms": [' + ",".join(['{"polygon": 0}'] * (size // 8)) + "]}",
    "name": lambda size: '{"name": "' + "x" * size + '"}',
    "vertices": lambda size: '{"ceiling_height_m": 2.5, "rooms": [{"polygon": [' + "[0,0]," * (size // 4) + "[0,0]]}]}",
    "blanks": lambda size: " " * size,
    "marks": lambda size: "\ufeff" * size,
}


@pytest.mark.parametrize("kind", _TEXTS)
def test_invalid_plan_is_refused_in_linear_time(kind: str) -> None:
    def refuse(size: int) -> Callable[[], None]:
        content = _TEXTS[kind](size).encode()

        def work() -> None:
            with pytest.raises(InvalidFloorPlanError):
                FloorPlan.from_json(content)

        return work

    assert_no_worse_than_linear(refuse, 20_000)


@pytest.mark.parametrize(
    "packet",
    [
        lambda size: b"<a>" * (size // 7) + b"</a>" * (size // 7),
        lambda size: b"<a>" + b"<b/>" * (size // 4) + b"</a>",
        lambda size: b"<a " + b" ".join(b'a%d="1"' % k for k in range(size // 10)) + b"/>",
        lambda size: b"".join(b'<a xmlns="u%d">' % k for k in range(size // 20)) + b"</a>" * (size // 20),
        lambda size: b"<a>" + b"&amp;" * (size // 5) + b"</a>",
        lambda size: b"<a>" + b"<![CDATA[x]]>" * (size // 13) + b"</a>",
        lambda size: b"<" + b"a" * size + b"/>",
        lambda size: b'<a x="' + b"x" * size,
        lambda size: b"<!--" + b"-" * size,
        lambda size: b'<a xmlns:g="' + _GPANO + b'" g:PosePitchDegrees="' + b"9" * size + b'"/>',
    ],
    ids=["deep", "wide", "attributes", "namespaces", "entities", "cdata", "name", "open", "comment", "digits"],
)
def test_metadata_are_read_in_linear_time(packet: Callable[[int], bytes]) -> None:
    def read(size: int) -> Callable[[], object]:
        content = packet(size)
        return lambda: read_photo_sphere([content], width=512, height=256)

    assert_no_worse_than_linear(read, _PACKET)


def _picture(name: str) -> bytes:
    return picture_file(Image.new("RGB", (256, 128), (90, 90, 90)), name)


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


_PIECES = {
    "comments": ("JPEG", 2, _segment(0xFE, b"")),
    "exif": ("JPEG", 2, _segment(0xE1, b"Exif\0\0x")),
    "xmp": ("JPEG", 2, _segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0<a/>")),
    "profiles": ("JPEG", 2, _segment(0xE2, b"ICC_PROFILE\0\1\1x")),
    "fill bytes": ("JPEG", 2, b"\xff"),
    "texts": ("PNG", 33, png_chunk(b"tEXt", b"a\0b")),
    "unknown chunks": ("PNG", 33, png_chunk(b"abCd", b"")),
}


@pytest.mark.parametrize("kind", _PIECES)
def test_many_segments_are_read_in_linear_time(kind: str) -> None:
    name, offset, piece = _PIECES[kind]
    plain = _picture(name)

    def read(count: int) -> Callable[[], None]:
        content = plain[:offset] + piece * count + plain[offset:]

        def work() -> None:
            with suppress(InvalidPhotographError):
                read_sphere(content, height=32, width=64)

        return work

    assert_no_worse_than_linear(read, 1_000 if name == "JPEG" else 15_000)


def test_million_segments_are_refused_early_and_usual_counts_accepted() -> None:
    jpeg, png = _picture("JPEG"), _picture("PNG")
    for piece, message in ((_segment(0xFE, b""), "2000 segments"), (_segment(0xE1, b"Exif\0\0x"), "16 Exif segments")):
        with pytest.raises(InvalidPhotographError, match=message):
            read_sphere(jpeg[:2] + piece * 1_000_000 + jpeg[2:], height=32, width=64)
    for piece in (png_chunk(b"tEXt", b"a\0b"), png_chunk(b"IDAT", b"")):
        with pytest.raises(InvalidPhotographError, match="20000 chunks"):
            read_sphere(png[:33] + piece * 1_000_000 + png[33:], height=32, width=64)
    # 40 MB of metadata in the largest possible segments, and pixels in the smallest chunks that encoders write.
    check_segments(jpeg[:2] + _segment(0xE2, bytes(65_000)) * 640 + jpeg[2:], 20)
    check_segments(png[:33] + png_chunk(b"IDAT", bytes(4096)) * 10_000, 20)
    for content in (jpeg, png, _picture("WEBP"), b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n"):
        check_segments(content, 20)
