"""Synthetic scenes on disk in Structured3D's layout: contents of the files, and writing them."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from PIL import Image

from lalaloc_core.cli import main
from lalaloc_core.conventions import column_azimuths
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.learn.data.dataset import Split
from lalaloc_core.learn.data.structured3d import (
    EXCLUDED_BY_PAPER,
    FURNITURE,
    LIGHTING,
    OFFICIAL,
    Structured3D,
    scene_numbers,
)
from lalaloc_core.learn.data.structured3d_writer import build_annotation, layout_pixels, room_type, write_depth
from lalaloc_core.learn.data.synthetic import writing as module
from lalaloc_core.learn.data.synthetic.generated import split_renderer_cache
from lalaloc_core.learn.data.synthetic.writing import Synthesis, share_out, synthesise
from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS, wall_frame
from lalaloc_core.learn.synth.homes.plans import TEST, TRAIN, Home, generate_home, home_of
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.lighting import MOODS
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import RenderScene
from lalaloc_core.learn.synth.scene.shots import POSE_MARGIN_M, Shot, stage_rooms
from lalaloc_core.render.profile import layout_depth, wall_profile
from tests.strategies import present, seeds

# A seed whose first homes have four rooms each.
HEIGHT, SEED = 32, 267
NUMBERS: dict[Split, tuple[int, ...]] = {"test": (3250, 3251)}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "data"
    synthesise(Synthesis(root=folder, seed=SEED, height=HEIGHT), NUMBERS)
    return folder


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def homes_of(root: Path) -> Iterator[tuple[Path, Home, list[Shot]]]:
    """Yield the scenes of a folder with the homes and shots that they must show."""
    for number in NUMBERS["test"]:
        home, rng = home_of(TEST, SEED, number)
        yield root / f"scene_{number:05d}", home, stage_rooms(home, rng)


def spheres_of(root: Path) -> Iterator[tuple[Path, Shot]]:
    for folder, _, shots in homes_of(root):
        yield from ((folder / "2D_rendering" / str(shot.room_index) / "panorama", shot) for shot in shots)


def depth_of(sphere: Path, furniture: str) -> np.ndarray:
    """Return a depth image in millimetres."""
    return np.asarray(Image.open(sphere / furniture / "depth.png"), dtype=int)


# The annotation


class Annotation:
    """An independent look at an annotation, in matrices."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
        self.points = np.array([junction["coordinate"] for junction in document["junctions"]])
        self.line_junctions = np.array(document["lineJunctionMatrix"])
        self.plane_lines = np.array(document["planeLineMatrix"])
        self.types = [plane["type"] for plane in document["planes"]]

    def semantics(self, *kinds: str) -> list[dict[str, Any]]:
        return [semantic for semantic in self.document["semantics"] if semantic["type"] in kinds]

    @property
    def rooms(self) -> list[dict[str, Any]]:
        others = self.semantics("door", "window", "outwall")
        return [semantic for semantic in self.document["semantics"] if semantic not in others]

    def segments(self, plane: int) -> np.ndarray:
        """(lines, 2, 3)."""
        lines = np.flatnonzero(self.plane_lines[plane])
        return np.stack([self.points[np.flatnonzero(self.line_junctions[line])] for line in lines])

    def faces(self, plane: int) -> list[shapely.Polygon]:
        """Closed rings of a horizontal plane, seen from above."""
        lines = list(map(shapely.LineString, self.segments(plane)[..., :2]))
        return list(shapely.get_parts(shapely.polygonize(lines)))


def annotation_of(seed: int) -> tuple[Home, Annotation]:
    home = generate_home(np.random.default_rng(seed))
    return home, Annotation(json.loads(json.dumps(build_annotation(home.plan, home.openings))))


@given(seed=seeds())
@settings(max_examples=15)
def test_lines_have_two_ends_and_lie_in_their_planes(seed: int) -> None:
    _, found = annotation_of(seed)
    document = found.document
    assert document["cuboids"] == document["manhattan"] == []
    for key in ("junctions", "lines", "planes", "semantics"):
        assert [entry["ID"] for entry in document[key]] == list(range(len(document[key])))
    assert found.plane_lines.shape == (len(document["planes"]), len(document["lines"]))
    assert found.line_junctions.shape == (len(document["lines"]), len(document["junctions"]))
    assert (found.line_junctions.sum(axis=1) == 2).all()
    assert (found.line_junctions.sum(axis=0) == 3).all(), "three lines meet at every corner of a prism"
    for line, row in zip(document["lines"], found.line_junctions, strict=True):
        ends = found.points[np.flatnonzero(row)]
        direction = np.array(line["direction"])
        assert abs(np.linalg.norm(direction) - 1.0) < 1e-9
        assert np.linalg.norm(np.cross(ends - line["point"], direction), axis=1).max() < 1e-6
    for number, plane in enumerate(document["planes"]):
        normal = np.array(plane["normal"])
        assert abs(np.linalg.norm(normal) - 1.0) < 1e-9
        assert np.abs(found.segments(number) @ normal + plane["offset"]).max() < 1e-3
        assert plane["type"] == {0: "wall", 1: "floor", -1: "ceiling"}[round(normal[2])]


@given(seed=seeds())
@settings(max_examples=15)
def test_rooms_are_closed_and_match_the_plan(seed: int) -> None:
    home, found = annotation_of(seed)
    assert len(found.rooms) == len(home.plan.rooms)
    for semantic, room in zip(found.rooms, home.plan.rooms, strict=True):
        planes = {kind: [p for p in semantic["planeID"] if found.types[p] == kind] for kind in ("floor", "ceiling")}
        (floor,), (ceiling,) = planes["floor"], planes["ceiling"]
        for plane, height_m in ((floor, 0.0), (ceiling, room.ceiling_height_m)):
            (face,) = found.faces(plane)
            expected = shapely.Polygon(1000.0 * room.polygon_m)
            assert shapely.hausdorff_distance(face.exterior, expected.exterior) < 1e-3
            assert np.abs(found.segments(plane)[..., 2] - 1000.0 * height_m).max() < 1e-3
        assert len(semantic["planeID"]) == 2 + len(room.polygon_m)


@given(seed=seeds())
@settings(max_examples=15)
def test_normals_point_into_free_space(seed: int) -> None:
    home, found = annotation_of(seed)
    outline = shapely.union_all([room.shape for room in home.plan.rooms]).buffer(1e-9)
    for semantic in found.document["semantics"]:
        walls = [plane for plane in semantic["planeID"] if found.types[plane] == "wall"]
        for plane in walls:
            segments = found.segments(plane)
            lowest = segments[segments[..., 2].max(axis=1) < segments[..., 2].min() + 1e-6]
            longest = lowest[np.linalg.norm(lowest[:, 0] - lowest[:, 1], axis=1).argmax()]
            normal = np.array(found.document["planes"][plane]["normal"])
            beside = shapely.Point((longest.mean(axis=0) + normal)[:2] / 1000.0)
            if semantic["type"] == "outwall":
                assert outline.distance(beside) > 0.15
            elif semantic["type"] not in ("door", "window"):
                assert home.plan.rooms[semantic["ID"]].shape.contains(beside)


@given(seed=seeds())
@settings(max_examples=15)
def test_doors_and_windows_are_boxes_in_holes_of_walls(seed: int) -> None:
    home, found = annotation_of(seed)
    doors = [opening for opening in home.openings if opening.kind != "window"]
    between_rooms = sum(door.neighbour >= 0 for door in doors)
    assert len(found.semantics("door")) == len(doors) - between_rooms // 2
    assert len(found.semantics("window")) == len(home.openings) - len(doors)
    walls_of_rooms = [plane for room in found.rooms for plane in room["planeID"] if found.types[plane] == "wall"]
    holes: Counter[int] = Counter()
    for box in found.semantics("door", "window"):
        of_box = found.plane_lines[box["planeID"]]
        assert (of_box.sum(axis=1) == 4).all()
        assert set(of_box.sum(axis=0)) == {0, 2}, "the faces of a closed box share every edge"
        faces = [row for row in of_box if ((found.plane_lines[walls_of_rooms] & row).sum(axis=1) == 4).any()]
        holes[len(faces)] += 1
    assert holes[2] == between_rooms // 2
    assert holes[1] == len(home.openings) - between_rooms


def test_outer_wall_surrounds_the_home_as_official_tools_expect() -> None:
    home, found = annotation_of(3)
    (outwall,) = found.semantics("outwall")
    lines = np.flatnonzero(found.plane_lines[outwall["planeID"]].any(axis=0))
    ends = np.stack([found.points[np.flatnonzero(found.line_junctions[line])] for line in lines])
    on_floor = np.isclose(ends[..., 2], 0.0).all(axis=1)
    (outline,) = shapely.get_parts(shapely.polygonize(list(map(shapely.LineString, ends[on_floor, :, :2]))))
    assert all(outline.contains(shapely.Polygon(1000.0 * room.polygon_m)) for room in home.plan.rooms)


def test_outer_walls_have_no_zero_length_edge() -> None:
    home, _ = home_of(TRAIN, 0, 59)
    outside = shapely.union_all([room.shape.buffer(0.2, join_style="mitre") for room in home.plan.rooms])
    steps = np.diff(shapely.get_coordinates(outside), axis=0)
    assert np.linalg.norm(steps, axis=1).min() < 1e-9, "this home needs the care that is tested here"
    found = Annotation(build_annotation(home.plan, home.openings))
    ends = np.stack([found.points[np.flatnonzero(row)] for row in found.line_junctions])
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).min() > 0.9
    assert np.isfinite([line["direction"] for line in found.document["lines"]]).all()


def test_rooms_have_structured3d_types() -> None:
    names = ("bedroom 2", "living room", "closet 1", "storage", "dining room 12", "wine cellar")
    assert [room_type(name) for name in names] == [
        *("bedroom", "living room", "store room", "store room", "dining room", "undefined")
    ]


@pytest.mark.slow
def test_written_scene_is_read_back(root: Path) -> None:
    dataset = Structured3D(root)
    assert dataset.sphere_size == (HEIGHT, 2 * HEIGHT)
    assert dataset.scenes("test") == ["scene_03250", "scene_03251"]
    assert dataset.scenes("train") == []
    for folder, home, shots in homes_of(root):
        scene = dataset.load(folder.name)
        assert scene.plan.warnings == ()
        assert len(scene.cameras) == len(shots) == len(home.plan.rooms)
        for room, expected in zip(scene.plan.rooms, home.plan.rooms, strict=True):
            assert shapely.hausdorff_distance(room.shape.exterior, expected.shape.exterior) < 1e-6
            assert abs(room.ceiling_height_m - expected.ceiling_height_m) < 1e-6
        for camera, shot in zip(scene.cameras, shots, strict=True):
            assert camera.room_index == shot.room_index
            assert camera.heading == shot.heading == 0.0
            np.testing.assert_allclose(camera.position_m, shot.position_m, atol=1e-6)
            assert abs(camera.camera_height_m - shot.camera_height_m) < 1e-6
            assert set(camera.photographs) == set(dataset.appearances)


# Cameras


@given(seed=seeds())
@settings(max_examples=25)
def test_each_room_has_one_camera_at_the_home_s_height(seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    shots = stage_rooms(home, rng)
    assert [shot.room_index for shot in shots] == list(range(len(home.plan.rooms)))
    assert len({shot.camera_height_m for shot in shots}) == len({shot.seed for shot in shots}) == 1
    assert 1.2 <= shots[0].camera_height_m <= 1.7
    for shot, room in zip(shots, home.plan.rooms, strict=True):
        position = shapely.Point(shot.position_m)
        margin_m = min(POSE_MARGIN_M - 1e-9, 0.9 * shapely.maximum_inscribed_circle(room.shape).length)
        assert room.shape.contains(position)
        assert room.shape.exterior.distance(position) >= margin_m
        assert shot.camera_height_m <= room.ceiling_height_m - 0.3


@given(seed=seeds())
@settings(max_examples=25)
def test_layout_pixels_match_visible_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    shot = stage_rooms(home, rng)[int(rng.integers(len(home.plan.rooms)))]
    room = home.plan.rooms[shot.room_index]
    pixels = layout_pixels(room, shot.position_m, shot.camera_height_m)
    ceiling, floor = pixels[0::2], pixels[1::2]
    np.testing.assert_array_equal(ceiling[:, 0], floor[:, 0])
    assert (np.diff(floor[:, 0]) >= 0.0).all()
    assert (ceiling[:, 1] < 255.5).all()
    assert (floor[:, 1] > 255.5).all()
    azimuth = ((floor[:, 0] + 0.5) / 1024 - 0.5) * 2.0 * math.pi
    below = -(0.5 - (floor[:, 1] + 0.5) / 512) * math.pi
    above = (0.5 - (ceiling[:, 1] + 0.5) / 512) * math.pi
    distance_m = shot.camera_height_m / np.tan(below)
    np.testing.assert_allclose(distance_m * np.tan(above), room.ceiling_height_m - shot.camera_height_m, atol=1e-9)
    found = shot.position_m + distance_m[:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1)
    inner = np.linspace(1e-3, 1.0 - 1e-3, 500)[:, None]
    visible = []
    for corner in room.polygon_m:
        between = shot.position_m + inner * (corner - shot.position_m)
        if shapely.contains_xy(room.shape.buffer(1e-6), between[:, 0], between[:, 1]).all():
            visible.append(corner)
    assert len(found) == len(visible)
    assert np.linalg.norm(found[:, None] - np.array(visible)[None], axis=2).min(axis=0).max() < 1e-6


# Pictures


def test_every_room_has_nine_spheres_and_three_depths(root: Path) -> None:
    for sphere, shot in spheres_of(root):
        assert {path.name for path in sphere.iterdir()} == {"camera_xyz.txt", "layout.txt", *FURNITURE}
        room = shot.home.plan.rooms[shot.room_index]
        expected = layout_pixels(room, shot.position_m, shot.camera_height_m)
        np.testing.assert_allclose(np.loadtxt(sphere / "layout.txt"), expected, atol=1e-3)
        for furniture in FURNITURE:
            files = {path.name: path for path in (sphere / furniture).iterdir()}
            assert set(files) == {"depth.png", *(f"rgb_{light}light.png" for light in LIGHTING)}
            for name, path in files.items():
                with Image.open(path) as image:
                    assert image.size == (2 * HEIGHT, HEIGHT)
                    assert image.mode == ("I;16" if name == "depth.png" else "RGB")


def test_empty_depth_matches_the_layout_except_doors(root: Path) -> None:
    for sphere, shot in spheres_of(root):
        depth_m, room = depth_of(sphere, "empty") / 1000.0, shot.home.plan.rooms[shot.room_index]
        profile = wall_profile(shot.position_m[None], np.zeros(1), room.walls_m[None], 2 * HEIGHT)
        heights = np.array([shot.camera_height_m]), np.array([room.ceiling_height_m])
        layout_m = layout_depth(profile, *heights, HEIGHT)[0]
        azimuth = column_azimuths(2 * HEIGHT)
        foot = shot.position_m + profile[0][:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1)
        through = np.zeros(2 * HEIGHT, dtype=bool)
        for opening in shot.home.openings:
            if opening.room == shot.room_index and opening.kind in ("door_open", "opening"):
                start, along, _ = wall_frame(room, opening.wall)
                span = shapely.LineString([start + along * opening.start_m, start + along * opening.end_m])
                through |= shapely.distance(shapely.points(foot), span) < 0.02
        assert (depth_m[:, ~through] <= layout_m[:, ~through] + 1.1e-3).all()
        # Lamps, radiators and open doors' leaves stand in the way of the rest.
        assert (np.abs(depth_m - layout_m)[:, ~through] < 1.1e-3).mean() > 0.75
        assert depth_m.min() > 0.1


def test_furniture_only_shortens_depth(root: Path) -> None:
    hidden = []
    for sphere, _ in spheres_of(root):
        empty, simple, full = (depth_of(sphere, level) for level in ("empty", "simple", "full"))
        assert (np.maximum(simple, full) <= empty + 1).all()
        hidden.append([(depth < empty - 1).mean() for depth in (simple, full)])
    simple, full = np.mean(hidden, axis=0)
    assert 0.02 < simple < full


def test_light_changes_colours(root: Path) -> None:
    for (sphere, _), level in itertools.product(spheres_of(root), FURNITURE):
        blueness = []
        for light in ("cold", "raw", "warm"):
            pixels = np.asarray(Image.open(sphere / level / f"rgb_{light}light.png"), dtype=float)
            blueness.append(math.log(pixels[..., 2].mean() / pixels[..., 0].mean()))
            assert 40.0 < pixels.mean() < 220.0
        assert blueness[0] - 0.05 > blueness[1] > blueness[2] + 0.05


def test_pictures_in_several_lights_match_single_ones() -> None:
    home, rng = home_of(TEST, SEED, 3250)
    shot = stage_rooms(home, rng)[0]
    renderer = split_renderer_cache(TEST, SEED, None).renderer(HEIGHT, 2 * HEIGHT)
    pictures, depth_m = renderer.render_moods(shot, MOODS)
    for mood, picture in zip(MOODS, pictures, strict=True):
        alone = dataclasses.replace(shot, lighting=mood)
        assert (picture.int() - renderer.render([alone])[0].int()).abs().max() <= 1
        np.testing.assert_array_equal(renderer.depth_m([alone])[0].numpy(), depth_m.numpy())


def floors_and_ceilings(scene: RenderScene) -> np.ndarray:
    """Surfaces (2, rooms, columns) of every room's floor and ceiling."""
    used = np.stack([scene.rooms.floor_surface, scene.rooms.ceiling_surface]).astype(int)
    return scene.surfaces.rows[used]


def test_materials_do_not_depend_on_furniture_and_light(materials: MaterialLibrary) -> None:
    home, rng = home_of(TEST, SEED, 3250)
    for shot in stage_rooms(home, rng):
        seen = []
        for furniture, lighting in itertools.product(FURNITURE_LEVELS, MOODS):
            scene = build_scene(dataclasses.replace(shot, furniture=furniture, lighting=lighting), materials)
            walls = scene.surfaces.rows[scene.wall_surface]
            seen.append((scene.walls_m, walls, floors_and_ceilings(scene), scene.lights.position_m))
        for other in seen[1:]:
            for first, second in zip(seen[0], other, strict=True):
                np.testing.assert_array_equal(first, second)


def test_room_has_the_same_materials_from_the_next_room(materials: MaterialLibrary) -> None:
    home, rng = home_of(TEST, SEED, 3250)
    shots = stage_rooms(home, rng)
    scenes = [build_scene(shot, materials) for shot in shots]
    pairs = 0
    for shot, scene in zip(shots, scenes, strict=True):
        behind = [
            opening.neighbour
            for opening in home.openings
            if opening.room == shot.room_index and opening.kind in ("door_open", "opening") and opening.neighbour >= 0
        ]
        for slot, room in enumerate(dict.fromkeys(behind), start=1):
            np.testing.assert_array_equal(floors_and_ceilings(scene)[:, slot], floors_and_ceilings(scenes[room])[:, 0])
            pairs += 1
    assert pairs > 1


def test_depth_out_of_range_is_zero(tmp_path: Path) -> None:
    write_depth(tmp_path / "depth.png", np.array([[1.2345, 65.535, 65.536, np.inf, np.nan]]))
    assert np.asarray(Image.open(tmp_path / "depth.png")).tolist() == [[1234, 65535, 0, 0, 0]]


# Runs


@pytest.mark.slow
def test_interrupted_run_leaves_whole_scenes_and_resumes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rooms_of_first = len(home_of(TEST, SEED, 3250)[0].plan.rooms)
    rooms = itertools.count()
    write_room = module._write_room

    def interrupted(*arguments: Any) -> None:
        write_room(*arguments)
        if next(rooms) == rooms_of_first + 1:
            raise KeyboardInterrupt

    out = tmp_path / "data"
    with monkeypatch.context() as patch:
        patch.setattr(module, "_write_room", interrupted)
        with pytest.raises(KeyboardInterrupt):
            synthesise(Synthesis(root=out, seed=SEED, height=HEIGHT), NUMBERS)
    assert {path.name for path in out.iterdir()} == {"synthetic.json", "scene_03250"}
    # As a killed process would leave it.
    (out / "scene_03251.part" / "2D_rendering").mkdir(parents=True)
    before = (out / "scene_03250" / "annotation_3d.json").stat().st_mtime_ns
    assert synthesise(Synthesis(root=out, seed=SEED, height=HEIGHT), NUMBERS) == 1
    assert (out / "scene_03250" / "annotation_3d.json").stat().st_mtime_ns == before
    assert content(out) == content(root)
    assert synthesise(Synthesis(root=out, seed=SEED, height=HEIGHT), NUMBERS) == 0


@pytest.mark.slow
def test_files_do_not_depend_on_the_number_of_workers(root: Path, tmp_path: Path) -> None:
    assert synthesise(Synthesis(root=tmp_path / "data", seed=SEED, height=HEIGHT), NUMBERS, workers=2) == 2
    assert content(tmp_path / "data") == content(root)


def test_full_disk_is_an_error_without_partial_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(module, "write_depth", full)
    with pytest.raises(DatasetError, match="cannot be written: No space left") as caught:
        synthesise(Synthesis(root=tmp_path, seed=SEED, height=HEIGHT), NUMBERS)
    assert present(caught.value.path).name == "depth.png"
    assert {path.name for path in tmp_path.iterdir()} == {"synthetic.json"}


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
def test_ended_command_leaves_whole_scenes_and_no_process(tmp_path: Path, ending: signal.Signals) -> None:
    program = "import sys; from lalaloc_core.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["lab", "synth", "--scenes", "40", "--split", "test", "--out", str(tmp_path), "--height", "64"]
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments, "--workers", "2"], start_new_session=True, stderr=subprocess.PIPE
    )
    wait_until(lambda: bool(list(tmp_path.glob("scene_*[0-9]"))))
    if ending == signal.SIGINT:
        # As a terminal does it.
        os.killpg(process.pid, ending)
    else:
        process.kill()
    _, errors = process.communicate(timeout=60.0)
    wait_until(lambda: not group_exists(process.pid))
    if ending == signal.SIGINT:
        assert process.returncode == 130
        assert b"run the same command again" in errors
        assert b"Traceback" not in errors
        assert list(tmp_path.glob("*.part")) == []


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def group_exists(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


# The command


def test_scenes_are_divided_like_the_official_splits() -> None:
    sizes = {split: len(found) for split, found in share_out(140, "all").items()}
    assert sizes == {"train": 120, "validation": 10, "test": 10}
    assert share_out(3, "all") == {"train": (0,), "validation": (3000,), "test": (3250,)}
    assert share_out(2, "test") == {"test": (3250, 3251)}
    assert share_out(3474, "all") == {split: scene_numbers(split) for split in OFFICIAL}
    for scenes in (1, 2, 4, 100, 1000, 3473):
        shared = share_out(scenes, "all")
        assert sum(len(found) for found in shared.values()) == scenes
        for split, found in shared.items():
            assert set(found) <= set(OFFICIAL[split]) - set(EXCLUDED_BY_PAPER[split])


@pytest.mark.parametrize(("scenes", "split"), [(250, "test"), (3475, "all"), (0, "all"), (-1, "train")])
def test_too_many_scenes_for_a_split_are_refused(scenes: int, split: Any) -> None:
    with pytest.raises(InvalidInputError, match=rf"^scenes is {scenes}; the limits of .* are 1 to \d+"):
        share_out(scenes, split)


@pytest.mark.slow
def test_command_writes_and_extends_scenes(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    common = ["lab", "synth", "--out", str(out), "--height", str(HEIGHT), "--seed", str(SEED)]
    assert main([*common, "--scenes", "1", "--split", "test"]) == 0
    assert main([*common, "--scenes", "1", "--split", "validation"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{out}: 1 validation; 1 of them new"
    assert Structured3D(out).scenes("validation") == ["scene_03000"]
    assert content(out / "scene_03250") == content(root / "scene_03250")
    stored = json.loads((out / "synthetic.json").read_text())
    assert stored == {"format": 1, "seed": SEED, "height": HEIGHT, "width": 2 * HEIGHT, "textures": None}


def test_folder_with_other_scenes_is_refused(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = content(root)
    assert main(["lab", "synth", "--scenes", "3", "--out", str(root), "--height", "64", "--seed", str(SEED)]) == 2
    message = capsys.readouterr().err
    assert f"its scenes were generated with height {HEIGHT}, not 64; width {2 * HEIGHT}, not 128" in message
    assert "seed" not in message
    assert content(root) == before
    (tmp_path / "scene_00000").mkdir()
    assert main(["lab", "synth", "--scenes", "3", "--out", str(tmp_path)]) == 2
    assert "holds 'scene_00000' but no synthetic.json" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["lab", "synth", "--scenes", "3", "--out", str(tmp_path / "file")]) == 2
    assert "cannot be written: File exists" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"scene_00000", "file"}
