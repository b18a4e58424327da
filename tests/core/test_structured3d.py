"""Structured3D reader: plans, poses and pictures, and refusal of bad files."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.assembly import OpenRingError, chain_rings, largest_simple_part
from lalaloc_core.learn.data.dataset import Appearance, DatasetPhotograph, load_scenes
from lalaloc_core.learn.data.structured3d import EXCLUDED_BY_PAPER, OFFICIAL, Structured3D, scene_numbers
from lalaloc_core.learn.data.structured3d_annotation import Annotation, read_annotation
from lalaloc_core.render.profile import layout_depth, wall_profile
from lalaloc_core.render.sampling import random_poses
from tests.strategies import crooked_flat, plan_of, plans, rectangle, room_polygons, same_ring, seeds
from tests.structured3d_scene import (
    HEIGHT,
    WIDTH,
    Drawing,
    Stand,
    drawing_of,
    room_id,
    write_annotation,
    write_camera,
    write_scene,
    write_synthetic,
)

NAME = "scene_03250"
STANDS = (Stand(room_index=0, x_m=1.1, y_m=0.9), Stand(room_index=2, x_m=3.2, y_m=5.1, height_m=1.7))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Create scenes of small spheres, with one test scene of two cameras."""
    write_synthetic(tmp_path)
    write_scene(tmp_path / NAME, crooked_flat(), STANDS, np.random.default_rng(1))
    return tmp_path


def sphere_of(root: Path, room_index: int = 0) -> Path:
    return root / NAME / "2D_rendering" / room_id(room_index) / "panorama"


def annotation_of(folder: Path, document: dict[str, Any]) -> Annotation:
    write_annotation(folder, document)
    return read_annotation(folder / "annotation_3d.json", NAME)


def drawn(folder: Path, drawing: Drawing) -> Annotation:
    return annotation_of(folder, drawing.to_document(np.random.default_rng(0)))


def photograph_of(root: Path) -> DatasetPhotograph:
    scene = Structured3D(root).load(NAME)
    return scene.photograph(scene.cameras[0], Appearance("full", "warm"))


def replace_file(path: Path, content: bytes | slice | None) -> None:
    """Replace a file by other bytes, by a part of its own, or by nothing."""
    stored = path.read_bytes()
    path.unlink()
    if content is not None:
        path.write_bytes(stored[content] if isinstance(content, slice) else content)


def refused(root: Path, *reasons: str, room: str | None = None, name: str = NAME) -> DatasetError:
    """Check that loading fails with an error that names scene, room, file and reasons."""
    with pytest.raises(DatasetError) as caught:
        Structured3D(root).load(name)
    error = caught.value
    assert error.scene == name
    assert error.room == room
    assert error.path is not None
    for reason in reasons:
        assert reason in str(error)
    return error


class TestRings:
    @given(st.integers(3, 12), seeds())
    def test_shuffled_lines_form_the_ring(self, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        ring = rng.permutation(100)[:count].tolist()
        lines = [(ring[k], ring[(k + 1) % count]) for k in rng.permutation(count)]
        (found,) = chain_rings([line if rng.random() < 0.5 else line[::-1] for line in lines])
        assert sorted(found) == sorted(ring)
        steps = {frozenset(line) for line in lines}
        assert {frozenset((junction, found[k - 1])) for k, junction in enumerate(found)} == steps

    @pytest.mark.parametrize("lines", [[(0, 1), (1, 2)], [(0, 1), (1, 2), (2, 0), (2, 3)], [(4, 4)] * 2])
    def test_open_ring_error_names_the_junction(self, lines: list[tuple[int, int]]) -> None:
        with pytest.raises(OpenRingError, match=r"junction \d joins \d of its lines"):
            chain_rings(lines)

    def test_largest_simple_part_of_crossing_outlines(self) -> None:
        square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        assert largest_simple_part(square)[1] == 1.0
        spike = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [4.0, 5.0], [4.0, 3.0], [0.0, 3.0]])
        polygon, share = largest_simple_part(spike)
        assert share == pytest.approx(1.0)
        assert same_ring(polygon[::-1], square, 1e-9) or same_ring(polygon, square, 1e-9)
        bow_tie = np.array([[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 2.0]])
        assert largest_simple_part(bow_tie)[1] == pytest.approx(0.5)
        flat = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        assert largest_simple_part(flat)[1] == 0.0


class TestPlan:
    @settings(max_examples=40)
    @given(plans(), seeds(), st.floats(-3.0, 3.0))
    def test_plan_round_trip(self, tmp_path: Path, plan: FloorPlan, seed: int, floor_m: float) -> None:
        rng = np.random.default_rng(seed)
        annotation = annotation_of(tmp_path, drawing_of(plan, rng, floor_m).to_document(rng))
        assert len(annotation.plan.rooms) == len(plan.rooms)
        for index, (found, true) in enumerate(zip(annotation.plan.rooms, plan.rooms, strict=True)):
            assert same_ring(found.polygon_m, true.polygon_m, 1e-3)
            assert found.ceiling_height_m == pytest.approx(true.ceiling_height_m, abs=1e-3)
            (floor,) = annotation.floors[room_id(index)]
            assert floor.room_index == index
            assert floor.z_m == pytest.approx(floor_m, abs=1e-3)
        assert not annotation.plan.warnings

    def test_rooms_are_named_by_type_and_id(self, root: Path) -> None:
        plan = Structured3D(root).load(NAME).plan
        assert [room.name for room in plan.rooms] == ["living room 1007", "kitchen 1020", "bedroom 1033"]
        assert plan.name == NAME

    def test_door_lines_on_the_floor_are_ignored(self, tmp_path: Path) -> None:
        drawing = drawing_of(crooked_flat(), np.random.default_rng(0))
        floor = next(plane for kind, plane in drawing.planes if kind == "floor")
        door = next(semantic for semantic in drawing.semantics if semantic["type"] == "door")
        floor.extend(drawing.planes[door["planeID"][0]][1][:1])
        annotation = drawn(tmp_path, drawing)
        assert same_ring(annotation.plan.rooms[0].polygon_m, crooked_flat().rooms[0].polygon_m, 1e-3)

    def test_second_ring_in_a_floor_is_a_hole(self, tmp_path: Path) -> None:
        drawing = drawing_of(crooked_flat(), np.random.default_rng(0))
        pillar = [drawing.junction(x, y, 0.0) for x, y in ((900, 900), (1200, 900), (1200, 1200))]
        drawing.planes[0][1].extend(drawing.ring(pillar))
        plan = drawn(tmp_path, drawing).plan
        assert same_ring(plan.rooms[0].polygon_m, crooked_flat().rooms[0].polygon_m, 1e-3)
        (hole,) = plan.rooms[0].holes_m
        assert same_ring(hole, np.array([[0.9, 0.9], [1.2, 1.2], [1.2, 0.9]]), 1e-3)
        assert plan.warnings == ()

    def test_room_with_two_floors_becomes_two_rooms(self, tmp_path: Path) -> None:
        drawing = Drawing()
        planes = drawing.prism(1000.0 * np.array(rectangle(3.0, 3.0)), 0.0, 2500.0)
        planes += drawing.prism(1000.0 * np.array(rectangle(2.0, 3.0, corner=(3.0, 0.0))), 300.0, 2500.0)[:1]
        drawing.semantics.append({"ID": 4, "type": "studio", "planeID": planes})
        annotation = drawn(tmp_path, drawing)
        assert [room.name for room in annotation.plan.rooms] == ["studio 4", "studio 4 (2)"]
        assert [room.ceiling_height_m for room in annotation.plan.rooms] == pytest.approx([2.5, 2.2])
        assert [floor.z_m for floor in annotation.floors["4"]] == pytest.approx([0.0, 0.3])

    def test_sloping_ceiling_is_a_warning(self, tmp_path: Path) -> None:
        drawing = drawing_of(crooked_flat(), np.random.default_rng(0))
        drawing.junctions[len(crooked_flat().rooms[0].polygon_m)][2] += 600.0
        plan = drawn(tmp_path, drawing).plan
        assert plan.rooms[0].ceiling_height_m == pytest.approx(2.6)
        assert "not level; its height varies by 0.60 m" in plan.warnings[0]

    def test_tiny_room_is_left_out_with_a_warning(self, tmp_path: Path) -> None:
        plan = crooked_flat()
        drawing = drawing_of(plan, np.random.default_rng(0))
        planes = drawing.prism(np.array([[9000.0, 0.0], [9300.0, 0.0], [9300.0, 300.0], [9000.0, 300.0]]), 0, 2500)
        drawing.semantics.insert(0, {"ID": 5, "type": "store room", "planeID": planes})
        annotation = drawn(tmp_path, drawing)
        assert len(annotation.plan.rooms) == len(plan.rooms)
        assert "store room 5" in annotation.plan.warnings[0]
        assert "0.09 m²" in annotation.plan.warnings[0]
        assert annotation.floors["5"] == ()
        assert annotation.floors[room_id(0)][0].room_index == 0

    def test_crossing_outline_is_repaired_with_a_warning(self, tmp_path: Path) -> None:
        drawing = Drawing()
        outline = np.array([[0, 0], [4000, 0], [4000, 3000], [0, 2900], [0, 3000], [100, 2850]], dtype=float)
        drawing.semantics.append({"ID": 4, "type": "studio", "planeID": drawing.prism(outline, 0.0, 2500.0)})
        plan = drawn(tmp_path, drawing).plan
        assert plan.area_m2 == pytest.approx(abs(shapely.make_valid(shapely.Polygon(outline)).area) / 1e6, rel=0.1)
        assert "crosses itself" in plan.warnings[0]


def change_semantic(**changes: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        document["semantics"][0].update(changes)

    return change


def without(*keys: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def redrawn(change: Callable[[Drawing], object]) -> Callable[[dict[str, Any]], None]:
    def changed(document: dict[str, Any]) -> None:
        drawing = drawing_of(crooked_flat(), np.random.default_rng(0))
        change(drawing)
        document.update(drawing.to_document(np.random.default_rng(0)))

    return changed


def scaled(*factors: float) -> Callable[[dict[str, Any]], None]:
    return redrawn(lambda drawing: setattr(drawing, "junctions", (np.array(drawing.junctions) * factors).tolist()))


def first_line(*junctions: int) -> Callable[[dict[str, Any]], None]:
    """Return the change of the junctions of the first line of the first floor."""
    return redrawn(lambda drawing: drawing.lines.__setitem__(drawing.planes[0][1][0], junctions))


def two_sided(drawing: Drawing) -> None:
    """Reduce the floor to two lines between the same junctions."""
    floor = drawing.planes[0][1]
    del floor[2:]
    drawing.lines[floor[1]] = drawing.lines[floor[0]]


def short_line_matrix(document: dict[str, Any]) -> None:
    del document["lineJunctionMatrix"][document["planeLineMatrix"][0].index(1) :]


def bad_coordinate(value: Any) -> Callable[[dict[str, Any]], None]:
    return redrawn(lambda drawing: drawing.junctions.__setitem__(0, value))


def bow_tie(document: dict[str, Any]) -> None:
    drawing = Drawing()
    planes = drawing.prism(1000.0 * np.array([[0.0, 0.0], [4.0, 3.0], [4.0, 0.0], [0.0, 3.0]]), 0.0, 2500.0)
    drawing.semantics.append({"ID": 1007, "type": "living room", "planeID": planes})
    document.update(drawing.to_document(np.random.default_rng(0)))


def only_openings(document: dict[str, Any]) -> None:
    document["semantics"] = [semantic for semantic in document["semantics"] if semantic["type"] in ("door", "outwall")]


FIRST = "living room 1007"


class TestBadAnnotation:
    @pytest.mark.parametrize(
        ("change", "room", "reasons"),
        [
            (without("planeLineMatrix"), None, ["'planeLineMatrix' is missing"]),
            (lambda document: document.update(semantics={}), None, ["'semantics' must be a list"]),
            (only_openings, None, ["no room"]),
            (without("semantics", 0, "type"), None, ["semantic 0 has no 'type'"]),
            (without("semantics", 0, "ID"), "living room None", ["no 'ID'"]),
            (without("semantics", 0, "planeID"), FIRST, ["no list 'planeID'"]),
            (change_semantic(planeID=[0, 9999]), FIRST, ["'planes' has no entry 9999"]),
            (change_semantic(planeID=["0"]), FIRST, ["'planes' has no entry '0'"]),
            (change_semantic(planeID=[-1]), FIRST, ["'planes' has no entry -1"]),
            (change_semantic(planeID=[1, 2]), FIRST, ["no floor among its planes [1, 2]"]),
            (change_semantic(planeID=[0, 2]), FIRST, ["no ceiling among its planes [0, 2]"]),
            (without("planes", 0, "type"), FIRST, ["plane 0 has no 'type'"]),
            (redrawn(lambda drawing: drawing.planes[0][1].clear()), FIRST, ["floor plane 0 has no lines"]),
            (
                redrawn(lambda drawing: drawing.planes[0][1].pop()),
                FIRST,
                ["does not close", "joins 1 of its lines, not two", "floor plane 0"],
            ),
            # An upright line of a wall joins the floor.
            (redrawn(lambda drawing: drawing.planes[0][1].append(drawing.planes[2][1][1])), FIRST, ["does not close"]),
            (redrawn(two_sided), FIRST, ["a ring has 2 junctions", "the minimum is three"]),
            (first_line(0, 0), FIRST, ["has 1 junctions; two are required"]),
            (first_line(0, 1, 2), FIRST, ["has 3 junctions; two are required"]),
            (short_line_matrix, FIRST, ["'lineJunctionMatrix' has no entry"]),
            (bad_coordinate([0.0, 1.0]), FIRST, ["[0.0, 1.0]", "three numbers"]),
            (bad_coordinate([0.0, 1.0, float("nan")]), FIRST, ["nan", "three numbers"]),
            (bad_coordinate("origin"), FIRST, ["origin", "three numbers"]),
            (bow_tie, FIRST, ["crosses itself", "50%", "90%"]),
            (scaled(0.001), "bedroom 1033", ["every room is smaller than 0.2 m²", "read as millimetres"]),
            # The plan is 10 km wide, and its ceilings stay.
            (scaled(2000.0, 2000.0, 1.0), None, ["m across; the limit is 1000 m", "read as millimetres"]),
            (scaled(1000.0), FIRST, ["ceiling_height_m is 2500", "read as millimetres"]),
        ],
    )
    def test_bad_annotation_is_refused(
        self, root: Path, change: Callable[[dict[str, Any]], None], room: str | None, reasons: list[str]
    ) -> None:
        document = json.loads((root / NAME / "annotation_3d.json").read_text())
        change(document)
        write_annotation(root / NAME, document)
        error = refused(root, *reasons, room=room)
        assert error.path == root / NAME / "annotation_3d.json"

    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (None, "cannot be read: No such file"),
            (slice(-500), "not valid JSON"),
            (b"[]", "must hold an object, not list"),
            (b"\xff\xfe{", "not valid JSON"),
        ],
    )
    def test_unreadable_file_is_refused(self, root: Path, content: bytes | slice | None, reason: str) -> None:
        path = root / NAME / "annotation_3d.json"
        replace_file(path, content)
        refused(root, reason, str(path))

    def test_bad_plan_is_raised_despite_problems(self, root: Path) -> None:
        (root / NAME / "annotation_3d.json").write_bytes(b"{}")
        problems: list[DatasetError] = []
        with pytest.raises(DatasetError):
            Structured3D(root).load(NAME, problems)
        assert list(load_scenes(Structured3D(root), [NAME], problems)) == []
        assert [problem.scene for problem in problems] == [NAME]


class TestCameras:
    def test_camera_poses_round_trip(self, root: Path) -> None:
        cameras = Structured3D(root).load(NAME).cameras
        assert [camera.name for camera in cameras] == [room_id(0), room_id(2)]
        for camera, stand in zip(cameras, STANDS, strict=True):
            assert camera.room_index == stand.room_index
            assert camera.position_m.tolist() == pytest.approx([stand.x_m, stand.y_m])
            assert camera.camera_height_m == pytest.approx(stand.height_m)
            assert camera.heading == 0.0

    def test_camera_height_is_above_the_floor(self, tmp_path: Path) -> None:
        write_synthetic(tmp_path)
        write_scene(tmp_path / NAME, crooked_flat(), STANDS, np.random.default_rng(1), floor_m=-2.2)
        cameras = Structured3D(tmp_path).load(NAME).cameras
        assert [camera.camera_height_m for camera in cameras] == pytest.approx([1.4, 1.7])

    @settings(max_examples=10)
    @given(room_polygons(), seeds())
    def test_depth_matches_the_layout_at_heading_zero(
        self, tmp_path_factory: pytest.TempPathFactory, polygon: list[list[float]], seed: int
    ) -> None:
        root = tmp_path_factory.mktemp("scenes")
        rng = np.random.default_rng(seed)
        plan = plan_of(polygon)
        (x_m, y_m) = random_poses(plan, 1, rng).position_m[0].tolist()
        write_synthetic(root)
        write_scene(root / NAME, plan, [Stand(room_index=0, x_m=x_m, y_m=y_m)], rng)
        scene = Structured3D(root).load(NAME)
        (camera,) = scene.cameras
        measured = scene.photograph(camera, Appearance("full", "warm")).depth_m()
        heading = np.array([camera.heading])
        profile = wall_profile(camera.position_m[None], heading, scene.plan.walls_m[[camera.room_index]], WIDTH)
        height, ceiling = np.array([camera.camera_height_m]), scene.plan.ceiling_heights_m[[camera.room_index]]
        expected = layout_depth(profile, height, ceiling, HEIGHT)[0]
        # A ray that grazes a corner may meet either wall.
        assert np.mean(np.abs(measured - expected) > 2e-3) <= 2.0 / WIDTH

    def test_scene_without_renderings_has_no_camera(self, root: Path) -> None:
        write_scene(root / "scene_03251", crooked_flat(), [], np.random.default_rng(0))
        assert Structured3D(root).load("scene_03251").cameras == ()

    def test_rooms_without_sphere_are_skipped(self, root: Path) -> None:
        rendering = root / NAME / "2D_rendering"
        (rendering / "77" / "perspective").mkdir(parents=True)
        (rendering / ".cache").mkdir()
        (rendering / "notes.txt").write_text("")
        assert len(Structured3D(root).load(NAME).cameras) == len(STANDS)

    @pytest.mark.parametrize(
        ("content", "reasons"),
        [
            (None, ["cannot be read: No such file", "camera_xyz.txt"]),
            (b"", ["holds ''", "three numbers"]),
            (b"1 2 3 4", ["holds '1 2 3 4'"]),
            (b"1 2 high", ["high"]),
            (b"1 2 nan", ["nan"]),
            (b"\xff\xfe", ["not a text file"]),
            (b"-9000 900 1400", ["(-9.000, 0.900) m is outside its room 'living room 1007', 9 m away"]),
            (b"1000 5000 1400", ["outside its room 'living room 1007'", "in 'bedroom 1033'"]),
            (b"1.1 0.9 1.4", ["0.0014 m above the floor", "read as millimetres"]),
            (b"1100 900 0", ["is 0 m above the floor; the minimum is 0.1 m"]),
            (b"1100 900 2500", ["must be below the ceiling (2.5 m)"]),
        ],
    )
    def test_bad_camera_position_is_refused_or_left_out(
        self, root: Path, content: bytes | None, reasons: list[str]
    ) -> None:
        path = sphere_of(root) / "camera_xyz.txt"
        replace_file(path, content)
        error = refused(root, *reasons, room=room_id(0))
        assert error.path == path
        problems: list[DatasetError] = []
        scene = Structured3D(root).load(NAME, problems)
        assert [camera.name for camera in scene.cameras] == [room_id(2)]
        assert [str(problem) for problem in problems] == [str(error)]

    def test_unknown_room_folder_is_refused(self, root: Path) -> None:
        (root / NAME / "2D_rendering" / room_id(0)).rename(root / NAME / "2D_rendering" / "4711")
        refused(root, "no room with this ID", room="4711")

    def test_camera_of_a_tiny_room_is_refused(self, root: Path) -> None:
        drawing = drawing_of(crooked_flat(), np.random.default_rng(0))
        planes = drawing.prism(np.array([[9000.0, 0.0], [9300.0, 0.0], [9300.0, 300.0], [9000.0, 300.0]]), 0, 2500)
        drawing.semantics.append({"ID": 5, "type": "store room", "planeID": planes})
        write_annotation(root / NAME, drawing.to_document(np.random.default_rng(0)))
        sphere = root / NAME / "2D_rendering" / "5" / "panorama"
        sphere.mkdir(parents=True)
        write_camera(sphere, 9150.0, 150.0, 1400.0)
        refused(root, "below the minimum area", room="5")


class TestPhotographs:
    def test_photographs_are_listed_by_appearance(self, tmp_path: Path) -> None:
        write_synthetic(tmp_path)
        looks = [("full", "warm"), ("full", "cold"), ("empty", "raw")]
        write_scene(tmp_path / NAME, crooked_flat(), STANDS[:1], np.random.default_rng(1), appearances=looks)
        dataset = Structured3D(tmp_path)
        assert dataset.appearances[0] == Appearance("full", "warm")
        assert len(set(dataset.appearances)) == 9
        scene = dataset.load(NAME)
        (camera,) = scene.cameras
        assert set(camera.photographs) == {Appearance(*look) for look in looks}
        assert set(camera.photographs) <= set(dataset.appearances)
        with pytest.raises(DatasetError, match="no photograph 'simple/warm'; available: empty/raw, full/cold, full/w"):
            scene.photograph(camera, Appearance("simple", "warm"))

    def test_photographs_return_their_pixels(self, root: Path) -> None:
        photograph = photograph_of(root)
        stored = np.asarray(Image.open(sphere_of(root) / "full" / "rgb_warmlight.png"))
        np.testing.assert_array_equal(photograph.image(HEIGHT, WIDTH), stored)
        assert photograph.image(16, 32).shape == (16, 32, 3)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(photograph)).image(HEIGHT, WIDTH), stored)

    def test_depth_without_reading_is_nan(self, root: Path) -> None:
        path = sphere_of(root) / "full" / "depth.png"
        depth = np.asarray(Image.open(path)).copy()
        depth[3, 4] = 0
        Image.fromarray(depth).save(path)
        measured = photograph_of(root).depth_m()
        assert np.argwhere(np.isnan(measured)).tolist() == [[3, 4]]
        assert measured[5, 6] == depth[5, 6] / 1000.0

    def test_photographs_of_another_size_are_refused(self, root: Path) -> None:
        (root / "synthetic.json").unlink()
        photograph = photograph_of(root)
        for read in (lambda: photograph.image(HEIGHT, WIDTH), photograph.depth_m):
            with pytest.raises(DatasetError, match="the picture is 64 x 32; this data set requires 1024 x 512"):
                read()

    @pytest.mark.parametrize("file", ["rgb_warmlight.png", "depth.png"])
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (None, "cannot be read: No such file"),
            (b"\x89PNG\r\n\x1a\n", "not a readable picture"),
            (slice(0, -900), "damaged"),
        ],
    )
    def test_bad_photographs_are_refused(
        self, root: Path, file: str, content: bytes | slice | None, reason: str
    ) -> None:
        path = sphere_of(root) / "full" / file
        photograph = photograph_of(root)
        replace_file(path, content)
        with pytest.raises(DatasetError, match=reason) as caught:
            photograph.image(HEIGHT, WIDTH) if file.startswith("rgb") else photograph.depth_m()
        assert (caught.value.scene, caught.value.room, caught.value.path) == (NAME, room_id(0), path)

    def test_eight_bit_depth_is_refused(self, root: Path) -> None:
        path = sphere_of(root) / "full" / "depth.png"
        Image.fromarray(np.zeros((HEIGHT, WIDTH), dtype=np.uint8)).save(path)
        with pytest.raises(DatasetError, match="mode L; a 16-bit grey PNG is required"):
            photograph_of(root).depth_m()


class TestDataset:
    def test_splits_match_the_paper(self) -> None:
        assert [len(scene_numbers(split)) for split in ("train", "validation", "test")] == [2979, 246, 249]
        assert [len(numbers) for numbers in OFFICIAL.values()] == [3000, 250, 250]
        for split, numbers in EXCLUDED_BY_PAPER.items():
            assert set(numbers) <= set(OFFICIAL[split])
        assert sum(map(len, EXCLUDED_BY_PAPER.values())) == 26

    def test_scenes_on_disk_are_listed_by_split(self, tmp_path: Path) -> None:
        for name in ("scene_02999", "scene_00278", "scene_00002", "scene_03249", "scene_03307", "scene_03499", "other"):
            (tmp_path / name).mkdir()
        (tmp_path / "scene_00003").write_text("a file")
        dataset = Structured3D(tmp_path)
        assert dataset.scenes("train") == ["scene_00002", "scene_02999"]
        assert dataset.scenes("validation") == ["scene_03249"]
        assert dataset.scenes("test") == ["scene_03499"]

    @pytest.mark.parametrize("name", ["scene_1", "../scene_03250", "scene_03250/..", "kitchen", ""])
    def test_unknown_scene_name_is_refused(self, root: Path, name: str) -> None:
        refused(root, "names have the form 'scene_03250'", name=name)

    def test_synthetic_scenes_have_their_own_description(self, root: Path) -> None:
        dataset = Structured3D(root)
        assert dataset.description == "synthetic scenes (seed 5)"
        assert dataset.sphere_size == (HEIGHT, WIDTH)
        (root / "synthetic.json").unlink()
        assert Structured3D(root).description == "Structured3D"
        assert Structured3D(root).sphere_size == (512, 1024)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"format": 2}, "format is 2"),
            ({"seed": "x"}, "seed is 'x'"),
            ({"width": 100}, "100 x 32"),
            ({"height": 0, "width": 0}, "0 x 0"),
            ({"homes": 3}, "no key 'homes'"),
        ],
    )
    def test_bad_synthetic_file_is_refused(self, tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
        write_synthetic(tmp_path, **changes)
        with pytest.raises(DatasetError, match=reason) as caught:
            _ = Structured3D(tmp_path).description
        assert caught.value.path == tmp_path / "synthetic.json"

    def test_data_set_can_be_pickled(self, root: Path) -> None:
        dataset = Structured3D(root)
        again = pickle.loads(pickle.dumps(dataset))
        assert again == dataset
        assert len(pickle.dumps(dataset)) < 1000
        scene = pickle.loads(pickle.dumps(again.load(NAME)))
        assert len(scene.cameras) == len(STANDS)
