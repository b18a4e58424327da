"""ZInD reader: homes with known poses round-trip, bad files are refused; and openings of data sets."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings

from lalaloc_core.conventions import column_azimuths, row_elevations, wrap_angle
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, load_scenes
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening, opening_entries
from lalaloc_core.learn.data.structured3d_annotation import read_annotation
from lalaloc_core.learn.data.structured3d_writer import build_annotation
from lalaloc_core.learn.data.zind import Zind
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.render.sampling import random_poses
from tests.strategies import crooked_flat, plan_document, plan_of, plans, rectangle, same_ring, seeds
from tests.zind_home import CEILING_GREY, FLOOR_GREY, HEIGHT, SPHERES, WIDTH, TrueSphere, wall_colour, write_home
from tests.zind_home import write_homes as write_zind_homes

NAME = "0002/floor_01"
FIRST = "partial_room_01_pano_0"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_zind_homes(tmp_path, np.random.default_rng(3), (32, 64))
    return tmp_path


def change_home(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = root / "0002" / "zind_data.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def sphere(document: dict[str, Any], room: int = 1, pano: int = 0) -> dict[str, Any]:
    return document["merger"]["floor_01"][f"complete_room_{room:02d}"][f"partial_room_{room:02d}"][f"pano_{pano}"]


def changed(room: int = 1, pano: int = 0, **changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: sphere(document, room, pano).update(changes)


def moved(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: sphere(document)["floor_plan_transformation"].update(changes)


class TestRoundTrip:
    @pytest.mark.slow
    @settings(max_examples=25)
    @given(plans(), seeds())
    def test_plan_and_pose_round_trip(
        self, tmp_path_factory: pytest.TempPathFactory, plan: FloorPlan, seed: int
    ) -> None:
        rng = np.random.default_rng(seed)
        poses = random_poses(plan, 4, rng)
        taken = sorted(zip(poses.room_index.tolist(), poses.position_m.tolist(), strict=True))
        spheres = [
            TrueSphere(
                room_index=room,
                x_m=x_m,
                y_m=y_m,
                heading=float(rng.uniform(0.0, 2.0 * math.pi)),
                height_m=float(rng.uniform(1.0, 1.9)),
            )
            for room, (x_m, y_m) in taken
        ]
        root = tmp_path_factory.mktemp("zind")
        write_home(root / "0002", plan, spheres, rng, size=(4, 8))
        scene = Zind(root).load(NAME)
        rooms = sorted({room for room, _ in taken})
        assert len(scene.plan.rooms) == len(rooms)
        for found, room in zip(scene.plan.rooms, rooms, strict=True):
            assert same_ring(found.polygon_m, plan.rooms[room].polygon_m, 1e-6)
            assert found.ceiling_height_m == pytest.approx(plan.rooms[room].ceiling_height_m, abs=1e-9)
        assert len(scene.cameras) == len(spheres)
        for number, (camera, true) in enumerate(zip(scene.cameras, spheres, strict=True)):
            assert camera.name == true.name(number)
            assert camera.position_m.tolist() == pytest.approx([true.x_m, true.y_m], abs=1e-6)
            assert wrap_angle(camera.heading - true.heading) == pytest.approx(0.0, abs=1e-9)
            assert 0.0 <= camera.heading < 2.0 * math.pi
            assert camera.camera_height_m == pytest.approx(true.height_m, abs=1e-9)
            assert rooms[camera.room_index] == true.room_index

    def test_pixels_show_the_wall_at_their_azimuth(self, tmp_path: Path) -> None:
        """The picture is painted in ZInD's frame; the test casts the same rays in the plan frame."""
        plan = crooked_flat()
        write_home(tmp_path / "0002", plan, SPHERES, np.random.default_rng(8))
        scene = Zind(tmp_path).load(NAME)
        for camera in scene.cameras:
            pixels = scene.photograph(camera, Appearance()).image(HEIGHT, WIDTH).astype(int)
            expected = expected_pixels(
                plan, camera.room_index, camera.position_m, camera.heading, camera.camera_height_m
            )
            # Edges between walls are blurred by JPEG.
            differing = np.abs(pixels - expected).max(axis=2) > 60
            assert differing.mean() < 0.05
            mirrored = np.abs(pixels[:, ::-1] - expected).max(axis=2) > 60
            assert mirrored.mean() > 0.15, "the picture would not tell a mirrored frame"


def expected_pixels(
    plan: FloorPlan, room_index: int, position_m: np.ndarray, heading: float, camera_height_m: float
) -> np.ndarray:
    """Render the sphere by this project's conventions."""
    room = plan.rooms[room_index]
    pixels = np.zeros((HEIGHT, WIDTH, 3), dtype=int)
    for column, azimuth in enumerate(heading + column_azimuths(WIDTH)):
        end = position_m + 99.0 * np.array([math.sin(azimuth), math.cos(azimuth)])
        ray = shapely.LineString([position_m, end])
        hits = [shapely.LineString(wall.reshape(2, 2)).intersection(ray) for wall in room.walls_m]
        reach = [math.inf if hit.is_empty else hit.distance(shapely.Point(position_m)) for hit in hits]
        rises = min(reach) * np.tan(row_elevations(HEIGHT))
        pixels[:, column] = wall_colour(int(np.argmin(reach)))
        pixels[rises < -camera_height_m, column] = FLOOR_GREY
        pixels[rises > room.ceiling_height_m - camera_height_m, column] = CEILING_GREY
    return pixels


class TestDataset:
    def test_splits_match_the_partition(self, root: Path) -> None:
        dataset = Zind(root)
        scenes = [dataset.scenes(split) for split in ("train", "validation", "test")]
        assert scenes == [["0000/floor_01"], ["0001/floor_01"], [NAME]]
        assert dataset.description == "ZInD"
        assert dataset.appearances == (Appearance(),)
        assert pickle.loads(pickle.dumps(dataset)) == dataset

    def test_missing_homes_are_skipped(self, root: Path) -> None:
        (root / "zind_partition.json").write_text('{"test": ["0001", "0099"]}')
        assert Zind(root).scenes("test") == ["0001/floor_01"]
        assert Zind(root).scenes("train") == []

    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (None, "cannot be read: No such file"),
            ("[]", "must hold an object"),
            ('{"test": "0002"}', "'test' must be a list"),
            ('{"test": [2]}', "'test' must be a list"),
            ('{"test": ["../0002"]}', "'test' must be a list"),
            ('{"dev": []}', "unknown split 'dev'"),
        ],
    )
    def test_bad_partition_is_refused(self, root: Path, content: str | None, reason: str) -> None:
        path = root / "zind_partition.json"
        path.unlink()
        if content is not None:
            path.write_text(content)
        with pytest.raises(DatasetError, match=reason) as caught:
            Zind(root).scenes("test")
        assert caught.value.path == path

    def test_damaged_home_is_refused_when_loaded(self, root: Path) -> None:
        (root / "0002" / "zind_data.json").write_text("{")
        assert Zind(root).scenes("test") == ["0002"]
        problems: list[DatasetError] = []
        assert list(load_scenes(Zind(root), ["0002"], problems)) == []
        assert "not valid JSON" in str(problems[0])

    def test_floor_without_scale_is_a_problem(self, root: Path) -> None:
        change_home(root, lambda document: document["scale_meters_per_coordinate"].update(floor_01=None))
        assert Zind(root).scenes("test") == [NAME]
        problems: list[DatasetError] = []
        assert list(load_scenes(Zind(root), [NAME], problems)) == []
        assert [problem.scene for problem in problems] == [NAME]
        assert "no metric scale" in problems[0].reason

    def test_unknown_scene_and_floor_are_refused(self, root: Path) -> None:
        for name in ("../0002/floor_01", "/0002", "0002/floor_01/x", ""):
            with pytest.raises(DatasetError, match="names have the form '0000/floor_01'"):
                Zind(root).load(name)
        with pytest.raises(DatasetError, match="no floor 'floor_07'; available: floor_01"):
            Zind(root).load("0002/floor_07")

    def test_missing_picture_is_refused_when_read(self, root: Path) -> None:
        path = root / "0002" / "panos" / f"floor_01_{FIRST}.jpg"
        path.unlink()
        scene = Zind(root).load(NAME)
        photograph = scene.photograph(scene.cameras[0], Appearance())
        with pytest.raises(DatasetError, match="cannot be read: No such file") as caught:
            photograph.image(32, 64)
        assert (caught.value.scene, caught.value.room, caught.value.path) == (NAME, FIRST, path)
        with pytest.raises(DatasetError, match="no depth"):
            photograph.depth_m()


class TestRooms:
    def test_outline_comes_from_a_primary_sphere(self, root: Path) -> None:
        """The layout of a secondary sphere is ignored."""
        change_home(root, lambda document: sphere(document, 1, 1).update(layout_complete={"vertices": "none"}))
        assert len(Zind(root).load(NAME).plan.rooms) == 3

    def test_first_primary_sphere_with_layout_is_used(self, root: Path) -> None:
        def change(document: dict[str, Any]) -> None:
            del sphere(document, 1, 0)["layout_complete"]
            sphere(document, 1, 1)["is_primary"] = True

        change_home(root, change)
        scene = Zind(root).load(NAME)
        assert same_ring(scene.plan.rooms[0].polygon_m, crooked_flat().rooms[0].polygon_m, 1e-6)
        assert len(scene.cameras) == len(SPHERES)

    def test_inner_walls_are_holes(self, tmp_path: Path) -> None:
        document = plan_document(rectangle(5.0, 4.0))
        document["rooms"][0]["holes"] = [rectangle(0.1, 2.0, corner=(2.4, 1.0)), rectangle(0.5, 0.5, corner=(4.0, 0.5))]
        plan = FloorPlan.from_dict(document)
        sphere = TrueSphere(room_index=0, x_m=1.0, y_m=1.0, heading=0.7)
        write_home(tmp_path / "0002", plan, [sphere], np.random.default_rng(3), (4, 8))
        (room,) = Zind(tmp_path).load(NAME).plan.rooms
        pairs = zip(room.holes_m, plan.rooms[0].holes_m, strict=True)
        assert all(same_ring(found, hole, 1e-6) for found, hole in pairs)
        assert room.area_m2 == pytest.approx(5.0 * 4.0 - 0.2 - 0.25)

    @pytest.mark.parametrize(
        ("internal", "area_m2", "warning"),
        [
            ([[[1.0, -1.0], [1.0, 2.0], [1.5, 2.0], [1.5, -1.0]]], 19.0, None),
            ([[[2.4, -1.0], [2.4, 5.0], [2.5, 5.0], [2.5, -1.0]]], 20.0, "1 of 1 rings of inner walls are left out"),
            ([[[7.0, 0.0], [8.0, 0.0], [8.0, 1.0]]], 20.0, "1 of 1 rings of inner walls are left out"),
            ([[[1.0, 1.0], [2.0, 1.0]]], 20.0, "ring 0 of 'internal' is left out; it has no three points"),
            ([[[1.0, 1.0], [2.0, "x"], [3.0, 3.0]]], 20.0, "ring 0 of 'internal' is left out; ring 0 of 'internal'"),
            ({}, 20.0, "'internal' is left out; it is not a list of rings"),
        ],
        ids=["through the outline", "divides the room", "outside", "line", "no number", "no list"],
    )
    def test_unusual_inner_walls_are_cut_or_left_out(
        self, tmp_path: Path, internal: Any, area_m2: float, warning: str | None
    ) -> None:
        true_sphere = TrueSphere(room_index=0, x_m=3.0, y_m=3.0, heading=0.0)
        write_home(tmp_path / "0002", plan_of(rectangle(5.0, 4.0)), [true_sphere], np.random.default_rng(3), (4, 8))

        def change(document: dict[str, Any]) -> None:
            layout = sphere(document)["layout_complete"]
            shift = np.array(layout["vertices"][0])
            # The sphere's frame is mirrored, has the camera height of 1.5 m as its unit, and the same directions.
            layout["internal"] = internal and [
                [[shift[0] - x / 1.5, shift[1] + y / 1.5] if not isinstance(y, str) else [x, y] for x, y in ring]
                for ring in internal
            ]

        change_home(tmp_path, change)
        plan = Zind(tmp_path).load(NAME).plan
        assert plan.area_m2 == pytest.approx(area_m2)
        assert [warning in told for told in plan.warnings] == [True] if warning else plan.warnings == ()

    def test_room_without_layout_is_a_problem(self, root: Path) -> None:
        change_home(root, lambda document: sphere(document, 2, 2).pop("layout_complete"))
        problems: list[DatasetError] = []
        scene = Zind(root).load(NAME, problems)
        assert [room.name for room in scene.plan.rooms] == ["label 1 complete_room_01", "label 3 complete_room_03"]
        assert [problem.room for problem in problems] == ["partial_room_02_pano_2"]
        assert "'complete_room_02' has no usable layout_complete" in problems[0].reason
        with pytest.raises(DatasetError, match="complete_room_02"):
            Zind(root).load(NAME)

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (changed(is_inside=False), "is_inside is false"),
            (moved(translation=[99.0, 0.0]), "is outside its room 'label 1 complete_room_01'"),
            (moved(translation=[0.0]), r"translation is \[0.0\]; it must be two numbers"),
            (moved(translation=None), "translation is None"),
            (moved(rotation="north"), "rotation is 'north'; it must be a number"),
            (moved(rotation=float("nan")), "rotation is nan"),
            (moved(scale=0), "scale is 0; it must be a number above 0"),
            (changed(floor_plan_transformation=None), "no object 'floor_plan_transformation'"),
            (changed(camera_height=-1.0), "camera_height is -1.0"),
            (changed(camera_height=9.0), "must be below the ceiling"),
            (changed(image_path="../../secret.jpg"), "image_path is '../../secret.jpg'"),
            (changed(image_path="/etc/passwd"), "image_path is '/etc/passwd'"),
            (changed(image_path=7), "image_path is 7"),
        ],
    )
    def test_bad_sphere_is_refused_or_left_out(
        self, root: Path, change: Callable[[dict[str, Any]], None], reason: str
    ) -> None:
        # Another primary sphere draws the room, so that this one is a camera only.
        def both(document: dict[str, Any]) -> None:
            sphere(document, 1, 1)["is_primary"] = True
            sphere(document, 1, 0)["is_primary"] = False
            change(document)

        change_home(root, both)
        with pytest.raises(DatasetError, match=reason) as caught:
            Zind(root).load(NAME)
        assert (caught.value.scene, caught.value.room) == (NAME, FIRST)
        assert caught.value.path == root / "0002" / "zind_data.json"
        problems: list[DatasetError] = []
        scene = Zind(root).load(NAME, problems)
        assert [str(problem) for problem in problems] == [str(caught.value)]
        assert len(scene.cameras) == len(SPHERES) - 1

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (lambda document: document.pop("merger"), "'merger' and 'scale_meters_per_coordinate' must be objects"),
            (lambda document: document.update(scale_meters_per_coordinate={"floor_01": "big"}), "is 'big'"),
            (lambda document: document.update(scale_meters_per_coordinate={"floor_01": -1}), "is -1"),
            (lambda document: document["merger"].update(floor_01=[]), "no floor 'floor_01'"),
            (lambda document: document["merger"].update(floor_01={}), "the scene has no room"),
            (lambda document: document["merger"]["floor_01"].update(complete_room_01=[]), "must be an object"),
            (changed(layout_complete={"vertices": [[0, 0], [1, 1]]}), "'vertices' of at least three points"),
            (changed(layout_complete={"vertices": [[0, 0], [1, 1], [1, "x"]]}), "vertex 2 is .1, 'x'."),
            (changed(layout_complete=[]), "'vertices' of at least three points"),
            (changed(layout_complete={"vertices": [[0, 0], [2, 2], [2, 0], [0, 2]]}), "crosses itself"),
            (changed(ceiling_height="high"), "ceiling_height is 'high'"),
            (changed(ceiling_height=90.0), "ceiling_height_m is 135"),
            (lambda document: document.update(scale_meters_per_coordinate={"floor_01": 1e-6}), "ceiling|smaller than"),
            (lambda document: document.update(scale_meters_per_coordinate={"floor_01": 1e6}), "ceiling_height_m is"),
        ],
    )
    def test_bad_floor_is_refused(self, root: Path, change: Callable[[dict[str, Any]], None], reason: str) -> None:
        change_home(root, change)
        problems: list[DatasetError] = []
        with pytest.raises(DatasetError, match=reason) as caught:
            Zind(root).load(NAME, problems)
        assert caught.value.scene == NAME
        assert caught.value.path == root / "0002" / "zind_data.json"


def faces_of(plan: FloorPlan) -> list[tuple[int, int, int, str]]:
    """Return the positions of openings; passages count as doors, because Structured3D has no passages."""
    kinds = {"passage": "door"}
    return sorted(
        (face.room, face.wall, face.behind, kinds.get(kind := plan.openings[face.opening].kind, kind))
        for face in plan.opening_faces
    )


@pytest.mark.parametrize("seed", [0, 4, 9])
def test_structured3d_openings_round_trip(seed: int, tmp_path: Path) -> None:
    home = generate_home(np.random.default_rng(seed))
    path = tmp_path / "annotation_3d.json"
    path.write_text(json.dumps(build_annotation(home.plan, home.openings)))
    plan = read_annotation(path, "scene").plan
    assert faces_of(plan) == faces_of(home.plan)
    assert plan.opening_kinds == {"door", "window"}
    assert plan.warnings == ()
    assert [room.type for room in plan.rooms if room.type != "storage"] == [
        room.type for room in home.plan.rooms if room.type not in ("storage", "closet")
    ]
    heights = sorted((round(o.sill_m or 0.0, 6), round(o.head_m or 0.0, 6)) for o in plan.openings)
    assert heights == sorted((round(o.sill_m or 0.0, 6), round(o.head_m or 0.0, 6)) for o in home.plan.openings)


def test_unreadable_door_is_a_warning(tmp_path: Path) -> None:
    home = generate_home(np.random.default_rng(0))
    annotation = build_annotation(home.plan, home.openings)
    doors = [semantic for semantic in annotation["semantics"] if semantic["type"] == "door"]
    doors[0]["planeID"] = [10**6]
    doors[1]["planeID"] = []
    path = tmp_path / "annotation_3d.json"
    path.write_text(json.dumps(annotation))
    plan = read_annotation(path, "scene").plan
    assert len(plan.rooms) == len(home.plan.rooms)
    assert len(plan.openings) == len(home.plan.openings) - 2
    assert f"door {doors[0]['ID']} is left out: 'planeLineMatrix' has no entry 1000000" in plan.warnings[0]
    assert f"door {doors[1]['ID']} is left out: it has 0 corners" in plan.warnings[1]


@pytest.fixture
def zind(root: Path) -> Path:
    """Draw a door between two rooms, in both, and a window in the first."""

    def between(layout: dict[str, list], wall: int, begin: float, end: float) -> list[list[float]]:
        """Return a piece of a room's wall in the frame of the room's sphere."""
        vertices = layout["vertices"]
        start, stop = (np.array(vertices[(wall + k) % len(vertices)]) for k in (0, 1))
        return [(start + share * (stop - start)).tolist() for share in (begin, end)]

    def draw(document: dict[str, Any]) -> None:
        first, second = (sphere(document, room, pano)["layout_complete"] for room, pano in ((1, 0), (2, 2)))
        # The right wall of the first room is 2.2 m long, the left wall of the second 2.5 m, both from y = 0.
        first["doors"] = [*between(first, 1, 0.5 / 2.2, 1.4 / 2.2), [-1.0, 0.35]]
        second["doors"] = [*between(second, 3, 1.1 / 2.5, 2.0 / 2.5), [-1.0, 0.35]]
        first["windows"] = [*between(first, 0, 0.2, 0.5), [-0.4, 0.4]]

    change_home(root, draw)
    return root


def test_zind_openings_are_in_the_plan_once(zind: Path) -> None:
    plan = Zind(zind).load(NAME).plan
    assert [opening.kind for opening in plan.openings] == ["door", "window"]
    faces = sorted((face.room, face.wall, face.behind) for face in plan.opening_faces)
    assert faces == [(0, 0, -1), (0, 1, 1), (1, 3, 0)]
    np.testing.assert_allclose(np.sort(plan.openings[0].line_m[:, 1]), [0.5, 1.4], atol=1e-9)
    assert plan.openings[1].sill_m == pytest.approx(0.9)
    assert plan.openings[1].head_m == pytest.approx(2.1)
    assert plan.opening_kinds == {"door", "window", "passage"}
    assert plan.warnings == ()


def test_damaged_zind_lists_are_warnings(zind: Path) -> None:
    lists = {"doors": [[0, 0]], "windows": [[0, 0], [1, "x"], [0, 1]]}
    change_home(zind, lambda document: sphere(document)["layout_complete"].update(lists))
    plan = Zind(zind).load(NAME).plan
    assert [opening.kind for opening in plan.openings] == ["door"]
    assert any("'doors' is left out; it is not a list of triples" in warning for warning in plan.warnings)
    assert any("an entry of 'windows' is left out" in warning for warning in plan.warnings)


def test_first_of_overlapping_openings_is_kept() -> None:
    def drawn(y0: float, y1: float, x: float = 0.0) -> DrawnOpening:
        return DrawnOpening(kind="door", line_m=np.array([[x, y0], [x, y1]]))

    entries, warnings = opening_entries([drawn(0, 1), drawn(0.1, 0.9, 0.2), drawn(0.8, 2), drawn(3, 3.01)], {})
    assert [entry["line"] for entry in entries] == [[[0.0, 0.0], [0.0, 1.0]]]
    reasons = [warning.split(" is left out")[1][:20] for warning in warnings]
    assert reasons == [": it overlaps anothe", ": the minimum is 0.0"]
