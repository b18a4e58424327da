"""Annotated photographs: reading, galleries of similar rooms, and metrics on both."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from lalaloc_core.bundle import Bundle
from lalaloc_core.cli import main
from lalaloc_core.conventions import OPENING_CLASSES, TWO_PI, column_azimuths
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.report.photograph_report import FIGURES_FILE, PhotographResults, evaluate_photographs
from lalaloc_core.evaluate.report.report_tables import percent
from lalaloc_core.evaluate.runs.galleries import answers_in_galleries, describe_answers, foreign_plans, score_galleries
from lalaloc_core.evaluate.runs.photograph_reading import ReadPhotograph, read_photographs, read_views
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.learn.data.annotated import GALLERY_ROOMS, AnnotatedPhotographs, GalleryKey, build_gallery
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, read_annotation
from lalaloc_core.learn.data.dataset_detection import open_dataset
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening, DrawnRoom
from lalaloc_core.learn.dataset_names import GALLERIES
from lalaloc_core.learn.metrics import QUANTILES, measure_azimuths, score_classes, summarise_azimuths
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.encode.view_encoder import ViewEncoder
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sweep import sweep_layouts
from tests.core.questions import prediction_of
from tests.strategies import present

REAL = Path(__file__).parents[3] / "shared" / "real" / "annotated"
WIDTH = 256
# Room of 4 x 3 camera heights; the camera is 1 from its left wall and 1 from the wall behind it.
POLYGON = [[-1.0, -1.0], [3.0, -1.0], [3.0, 2.0], [-1.0, 2.0]]


def column_of(x: float, y: float) -> float:
    return (np.arctan2(x, y) / TWO_PI + 0.5) * WIDTH


def opening(kind: str, *line: list[float]) -> dict[str, Any]:
    return {"kind": kind, "columns": [column_of(*line[0]), column_of(*line[1])], "line": list(line)}


def annotation(name: str, **changes: Any) -> dict[str, Any]:
    return {
        "photograph": f"{name}.png",
        "room_type": "bedroom",
        "quality": "good",
        "polygon": POLYGON,
        "ceiling_above_camera": 0.8,
        "openings": [
            opening("window", [0.0, 2.0], [2.0, 2.0]),
            # Behind the camera, across the picture's border.
            opening("door", [0.5, -1.0], [-0.5, -1.0]),
        ],
        "notes": "",
    } | changes


def write(root: Path, name: str, **changes: Any) -> Path:
    document = annotation(name, **changes)
    pixels = np.random.default_rng(len(name)).integers(0, 255, (WIDTH // 2, WIDTH, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(root / f"{name}.png")
    path = root / f"{name}.json"
    path.write_text(json.dumps(document))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Write three photographs, one with two outlines and one of poor quality."""
    write(tmp_path, "hall", alternative_polygon=[[-1.0, -1.0], [5.0, -1.0], [5.0, 2.0], [-1.0, 2.0]])
    write(tmp_path, "den", quality="poor", openings=[], ceiling_above_camera=None)
    nook = [[-2.0, -1.5], [2.0, -1.5], [2.0, 0.5], [0.5, 0.5], [0.5, 1.5], [-2.0, 1.5]]
    write(tmp_path, "nook", polygon=nook, openings=[])
    return tmp_path


class TestReading:
    def test_lengths_use_the_assumed_camera_height(self, root: Path) -> None:
        hall = read_annotation(root / "hall.json")
        assert np.allclose(hall.outlines[0].polygon_m, CAMERA_HEIGHT_M * np.array(POLYGON))
        assert hall.outlines[0].ceiling_height_m == pytest.approx(1.8 * CAMERA_HEIGHT_M)
        # The centre column looks along +y, columns further right clockwise of it.
        profile_m = hall.profile_m(0, 64)
        ahead, right = profile_m[31:33].mean(), profile_m[47:49].mean()
        assert (ahead, right) == (pytest.approx(2.0 * 1.5, rel=0.01), pytest.approx(3.0 * 1.5, rel=0.01))

    def test_classes_wrap_around_the_border(self, root: Path) -> None:
        classes = read_annotation(root / "hall.json").classes(WIDTH)
        door, window = OPENING_CLASSES.index("door"), OPENING_CLASSES.index("window")
        assert classes[WIDTH // 2 + 5] == window
        assert classes[WIDTH // 2 - 5] == 0
        assert classes[0] == classes[-1] == door
        assert np.count_nonzero(classes == door) == pytest.approx(2 * np.arctan(0.5) / TWO_PI * WIDTH, abs=2)
        assert np.count_nonzero(classes == window) == pytest.approx(np.pi / 4 / TWO_PI * WIDTH, abs=2)

    def test_alternative_outline_keeps_its_openings(self, tmp_path: Path) -> None:
        alternative = [[-1.0, -1.0], [3.0, -1.0], [3.0, 2.5], [-1.0, 2.5]]
        first, second = read_annotation(write(tmp_path, "hall", alternative_polygon=alternative)).outlines
        assert [opening.kind for opening in first.openings] == ["window", "door"]
        assert [opening.kind for opening in second.openings] == ["door"]

    def test_occluded_opening_lies_on_its_wall(self, tmp_path: Path) -> None:
        # A pier in front of the wall hides the window beyond its corner at (1/2, 3/2).
        polygon = [[-2.0, -1.0], [2.0, -1.0], [2.0, 2.0], [1.0, 2.0], [1.0, 1.5], [0.5, 1.5], [0.5, 2.0], [-2.0, 2.0]]
        line = [-1.0, 2.0], [0.5, 1.5]
        corner = read_annotation(write(tmp_path, "corner", polygon=polygon, openings=[opening("window", *line)]))
        (piece,) = corner.outlines[0].openings
        assert piece.line_m / CAMERA_HEIGHT_M == pytest.approx(np.array([[-1.0, 2.0], [0.5, 2.0]]), abs=0.05)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"colour": "red"}, "unknown key 'colour'"),
            ({"quality": "superb"}, "quality is 'superb'; it must be one of good, fair, poor"),
            ({"photograph": "../hall.png"}, "it must be a path below"),
            ({"photograph": "lost.png"}, "photograph 'lost.png' cannot be read"),
            ({"photograph": "hall.json"}, "not a readable picture"),
            ({"ceiling_above_camera": -1.0}, "ceiling_above_camera is -1.0"),
            ({"polygon": [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]}, "the camera at (0, 0) is outside"),
            ({"polygon": [[-1, -1], [1, 1], [1, -1], [-1, 1.5]]}, "crosses itself"),
            ({"polygon": [[-1, -1], [400, -1], [1, 1]]}, "the limit is 60, and lengths are in camera heights"),
            ({"polygon": [[-1, -1], [1, -1], ["1", 1]]}, "it must be two numbers"),
            ({"openings": [{"kind": "door", "columns": [0, 9]}]}, "keys columns, kind, line"),
            ({"openings": [opening("hatch", [0.0, 2.0], [1.0, 2.0])]}, "kind is 'hatch'"),
            (
                {"openings": [opening("door", [0.0, 1.5], [1.0, 1.5])]},
                "is 0.5 camera heights from the outline; the limit is 0.1",
            ),
            (
                {"openings": [opening("door", [0.0, 2.0], [1.0, 2.0]) | {"columns": [128, 170]}]},
                "are at the columns 128, 147, but its columns are 128, 170; the maximum difference is 3",
            ),
            ({"openings": [opening("door", [0.0, 2.0], [1.0, 2.0]) | {"columns": [128, 257]}]}, "to the width, 256"),
            (
                {"openings": [opening("door", [0.0, 2.0], [1.0, 2.0]), opening("window", [0.5, 2.0], [2.0, 2.0])]},
                "(window) and opening 0 (door) overlap",
            ),
            ({"notes": 7}, "notes must be text"),
            ({"quality": None}, "the key 'quality' is missing"),
        ],
    )
    def test_invalid_annotation_is_refused_with_the_value(
        self, root: Path, changes: dict[str, Any], reason: str
    ) -> None:
        # None leaves a key out.
        document = {name: value for name, value in annotation("hall", **changes).items() if value is not None}
        (root / "hall.json").write_text(json.dumps(document))
        with pytest.raises(DatasetError) as caught:
            read_annotation(root / "hall.json")
        assert reason in str(caught.value)
        assert "hall" in str(caught.value)


class TestDrawnRooms:
    ROOM = DrawnRoom(
        name="r",
        polygon_m=np.array([[-1.0, -1.0], [3.0, -1.0], [3.0, 2.0], [-1.0, 2.0]]),
        ceiling_height_m=2.5,
        openings=(DrawnOpening(kind="door", line_m=np.array([[0.0, 2.0], [1.0, 2.0]])),),
    )

    @pytest.mark.parametrize("angle", [0.3, -0.5, 0.7])
    def test_main_direction_follows_rotation(self, angle: float) -> None:
        assert self.ROOM.turned(angle).main_direction == pytest.approx(angle)

    @pytest.mark.parametrize("change", ["turned", "scaled", "mirrored", "moved"])
    def test_transformed_openings_stay_on_the_outline(self, change: str) -> None:
        room = {
            "turned": self.ROOM.turned(0.4),
            "scaled": self.ROOM.scaled(1.3),
            "mirrored": self.ROOM.mirrored(),
            "moved": self.ROOM.moved(np.array([3.0, -2.0])),
        }[change]
        shape = shapely.Polygon(room.polygon_m)
        assert shape.exterior.is_ccw
        assert shapely.distance(shape.exterior, shapely.points(room.openings[0].line_m)).max() < 1e-9
        assert room.size_m == pytest.approx(self.ROOM.size_m * (1.3 if change == "scaled" else 1.0))


class TestGalleries:
    def test_gallery_profile_matches_the_annotation(self, root: Path) -> None:
        dataset = AnnotatedPhotographs(root)
        for name in dataset.scenes("test"):
            key = present(GalleryKey.from_scene(name))
            photograph = next(p for p in dataset.photographs if p.name == key.photograph)
            scene = dataset.load(name)
            (camera,) = scene.cameras
            seen_m = wall_profile(
                camera.position_m[None], np.array([camera.heading]), scene.plan.walls_m[[camera.room_index]], 64
            )[0]
            assert np.allclose(seen_m, photograph.profile_m(key.outline, 64), rtol=1e-6)

    def test_gallery_openings_match_the_annotation(self, root: Path) -> None:
        dataset = AnnotatedPhotographs(root)
        scene, hall = dataset.load("hall-0"), read_annotation(root / "hall.json")
        (camera,) = scene.cameras
        plan, rooms = scene.plan, np.array([camera.room_index])
        view = sweep_layouts(
            camera.position_m[None], np.array([camera.heading]), rooms, plan.wall_table, WIDTH, camera.camera_height_m
        )
        assert np.count_nonzero(view.kind[0] != hall.classes(WIDTH)) <= 6
        assert plan.opening_kinds == {"door", "window", "passage"}
        assert plan.rooms[camera.room_index].type == "bedroom"
        # The others have openings of their own.
        assert {face.room for face in plan.opening_faces} > set(rooms)

    def test_gallery_rooms_are_similar_and_apart(self, root: Path) -> None:
        scene = AnnotatedPhotographs(root).load("hall-0")
        rooms = scene.plan.rooms
        own = rooms[scene.cameras[0].room_index]
        assert len(rooms) == GALLERY_ROOMS
        assert scene.plan.warnings == ()
        nearest_m = [min(a.shape.distance(b.shape) for b in rooms if b is not a) for a in rooms]
        assert min(nearest_m) >= 1.0 - 1e-9
        ratios = np.array([np.sqrt(room.area_m2 / own.area_m2) for room in rooms if "home" in room.name])
        assert len(ratios) == GALLERY_ROOMS - 3
        assert np.abs(ratios - 1.0).max() <= 0.1 + 1e-9
        edges = np.roll(own.polygon_m, -1, axis=0) - own.polygon_m
        assert np.abs(edges).min(axis=1).max() < 1e-9

    def test_gallery_key_determines_the_plan(self, root: Path) -> None:
        first, again = (AnnotatedPhotographs(root).load("hall-1") for _ in range(2))
        assert first.plan.to_dict() == again.plan.to_dict()
        assert first.plan.to_dict() != AnnotatedPhotographs(root).load("hall-2").plan.to_dict()

    def test_both_outlines_share_the_other_rooms(self, root: Path) -> None:
        dataset = AnnotatedPhotographs(root)
        first, second = dataset.load("hall-0"), dataset.load("hall-0-alternative")
        own = first.cameras[0].room_index
        assert own == second.cameras[0].room_index
        for index, (a, b) in enumerate(zip(first.plan.rooms, second.plan.rooms, strict=True)):
            assert a.area_m2 == pytest.approx(b.area_m2) or index == own

    def test_generated_rooms_follow_the_given_size(self) -> None:
        small, large = TestDrawnRooms.ROOM, TestDrawnRooms.ROOM.scaled(2.0)
        plan, own, *_ = build_gallery(large, [], 1.5, np.random.default_rng(0), like=small)
        areas = np.array([room.area_m2 for room in plan.rooms])
        assert areas[own] == pytest.approx(4.0 * small.size_m**2)
        assert np.delete(areas, own).max() < 1.3 * small.size_m**2

    def test_folder_opens_as_a_data_set(self, root: Path) -> None:
        dataset = open_dataset(root)
        assert isinstance(dataset, AnnotatedPhotographs)
        assert dataset.scenes("train") == dataset.scenes("validation") == []
        # One photograph has two outlines, and one of poor quality has no gallery.
        assert len(dataset.scenes("test")) == 3 * GALLERIES
        assert list(dataset.scenes("test"))[:3] == ["hall-0", "hall-0-alternative", "nook-0"]

    @pytest.mark.parametrize("name", ["hall", "hall-x", "cellar-0", "nook-0-alternative"])
    def test_unknown_gallery_is_refused(self, root: Path, name: str) -> None:
        with pytest.raises(DatasetError, match="no such gallery"):
            AnnotatedPhotographs(root).load(name)

    def test_empty_folder_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match="no annotated photographs"):
            AnnotatedPhotographs(tmp_path).scenes("test")


class TestAzimuths:
    def test_laplace_errors_are_calibrated(self) -> None:
        rng = np.random.default_rng(0)
        scale = rng.uniform(0.05, 0.5, 20_000)
        measures = measure_azimuths([np.ones(20_000)], rng.laplace(0.0, scale), np.log(scale))
        assert measures.within == pytest.approx(QUANTILES, abs=0.01)
        assert measures.scale_ratio == pytest.approx(1.0, abs=0.03)
        assert measure_azimuths([np.ones(20_000)], rng.laplace(0.0, 3.0 * scale), np.log(scale)).scale_ratio > 2.8

    def test_better_of_two_outlines_counts_and_nan_is_an_infinite_error(self) -> None:
        near, far = np.full(8, 2.0), np.full(8, 5.0)
        measures = measure_azimuths([far, near], np.log(np.full(8, 2.2)), np.zeros(8))
        assert measures.outline == 1
        assert measures.median_error == measures.bias == pytest.approx(np.log(1.1))
        log_profile = np.where(np.arange(8) < 5, np.nan, 0.0)
        measures = measure_azimuths([np.ones(8)], log_profile, np.zeros(8))
        assert np.isinf(measures.median_error)
        assert measures.within == pytest.approx([3 / 8] * 4)

    def test_classes_are_scored_by_class(self) -> None:
        truth = np.array([0, 0, 0, 0, 1, 1, 2, 2])
        scores = np.eye(4)[np.array([0, 0, 0, 1, 1, 0, 2, 2])]
        measures = measure_azimuths([np.ones(8)], np.zeros(8), np.zeros(8), truth, scores)
        classes = score_classes(present(measures.confusion), OPENING_CLASSES)
        assert classes.recall == {"wall": 0.75, "door": 0.5, "window": 1.0, "passage": None}
        assert classes.precision == {"wall": 0.75, "door": 0.5, "window": 1.0, "passage": None}
        # A class that never occurs has no recall.
        assert classes.balanced_accuracy == pytest.approx(0.75)
        assert summarise_azimuths([measures, measures], OPENING_CLASSES).classes == classes


def answer(
    scene: str, *, room: int, x_m: float, rank: int | None, confidence: float = 0.5, heading_deg: float = 0.0
) -> Prediction:
    return prediction_of(
        Pose(x_m=0.0, y_m=0.0, room_index=3, heading_deg=0.0),
        scene=scene,
        camera="hall",
        room="hall",
        stages={"lpo": Pose(x_m=x_m, y_m=0.0, room_index=room, heading_deg=heading_deg)},
        room_rank=rank,
        confidence=confidence,
    )


class TestGalleryScores:
    @pytest.fixture
    def photographs(self, root: Path) -> tuple[AnnotatedPhotograph, ...]:
        return AnnotatedPhotographs(root).photographs

    def test_located_needs_the_right_room_and_distance(self, photographs: tuple[AnnotatedPhotograph, ...]) -> None:
        # The hall is 6 m by 4.5 m, so a tenth of its size is more than half a metre.
        near, far, elsewhere = 0.51, 0.53, 0.1
        predictions = [
            answer("hall-0", room=3, x_m=near, rank=1),
            answer("hall-1", room=3, x_m=far, rank=1),
            answer("hall-2", room=4, x_m=elsewhere, rank=3),
        ]
        scores = score_galleries(answers_in_galleries(predictions, photographs))
        assert (scores.located, scores.right_room, scores.among_3) == pytest.approx((1 / 3, 2 / 3, 1.0))
        assert scores.by_photograph == {"hall": pytest.approx(1 / 3)}
        assert describe_answers(answers_in_galleries(predictions, photographs), "hall") == "1 of 3 (ranks 1, 3)"
        assert describe_answers([], "den") == "not evaluated"

    def test_better_answer_of_two_outlines_counts(self, photographs: tuple[AnnotatedPhotograph, ...]) -> None:
        predictions = [
            answer("hall-0", room=4, x_m=9.0, rank=None),
            answer("hall-0-alternative", room=3, x_m=0.1, rank=1, confidence=0.9),
        ]
        (only,) = answers_in_galleries(predictions, photographs)
        assert (only.located, only.outline, only.confidence) == (True, 1, 0.9)
        assert score_galleries([only]).calibration_error == pytest.approx(0.1)

    def test_reversed_heading_is_reported(self, photographs: tuple[AnnotatedPhotograph, ...]) -> None:
        predictions = [
            answer("hall-0", room=3, x_m=0.1, rank=1, heading_deg=178.0),
            answer("hall-1", room=3, x_m=0.1, rank=1, heading_deg=355.0),
            answer("hall-2", room=4, x_m=0.1, rank=2, heading_deg=178.0),
        ]
        scores = score_galleries(answers_in_galleries(predictions, photographs))
        assert (scores.located, scores.turned) == pytest.approx((2 / 3, 1 / 3))

    def test_missing_answer_is_a_miss(self, photographs: tuple[AnnotatedPhotograph, ...]) -> None:
        truth = Pose(x_m=0.0, y_m=0.0, room_index=0, heading_deg=0.0)
        missing = prediction_of(truth, scene="nook-0", camera="nook", room="nook")
        (only,) = answers_in_galleries([missing], photographs)
        assert not only.located
        assert np.isinf(only.error_m)


class TestEvaluating:
    def test_reading_compares_encoder_predictions(self, root: Path, encoders: PhotographEncoder) -> None:
        photographs = AnnotatedPhotographs(root).photographs
        for read, photograph in zip(read_photographs(encoders, photographs), photographs, strict=True):
            image = photograph.photograph.image(encoders.manifest.image_height, encoders.manifest.image_width)
            profile_m, left_over = encoders.spheres.profile(image, 0.0, CAMERA_HEIGHT_M)
            assert left_over == 0.0
            azimuth = column_azimuths(len(profile_m))
            polygon = photograph.outlines[read.measures.outline].polygon_m
            walls = np.concatenate([polygon, np.roll(polygon, -1, axis=0)], axis=1)[None]
            # One ray at a time, by rotating a camera of one column.
            true_m = [wall_profile(np.zeros((1, 2)), np.array([a]), walls, 1)[0, 0] for a in azimuth]
            assert np.allclose(read.measures.log_error, np.log(profile_m) - np.log(true_m), atol=1e-5)

    def test_views_are_compared_at_the_azimuths_they_show(
        self, root: Path, tiny_view_bundle: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # The grey level of a pixel is its azimuth, by which the encoder of views knows the walls and openings.
        grey = np.broadcast_to(np.arange(WIDTH, dtype=np.uint8)[None, :, None], (WIDTH // 2, WIDTH, 3))
        Image.fromarray(grey).save(root / "hall.png")
        hall = read_annotation(root / "hall.json")
        encoders = PhotographEncoder(Bundle.open(tiny_view_bundle), threads=1)
        columns = encoders.manifest.profile_columns

        def outputs(_: object, images: list[np.ndarray], camera_height_m: float) -> dict[str, np.ndarray]:
            (image,) = images
            view = present(encoders.manifest.view)
            azimuths = np.linspace(0, image.shape[1] - 1, view.sectors * columns // encoders.manifest.ring_sectors)
            shown = image[image.shape[0] // 3].astype(int)[azimuths.round().astype(int)]
            log_m = np.log(0.9 * hall.profile_m(0, WIDTH))[shown[:, 0]]
            modes = np.stack([log_m, log_m], axis=1)[None]
            return {
                "log_profile": modes,
                "log_scale": np.full_like(modes, -3.0),
                "log_share": np.full_like(modes, np.log(0.5)),
                "seen": (shown[None, :, 3] > 0).astype(np.float32),
                "opening_logits": 20.0 * np.eye(len(OPENING_CLASSES))[hall.classes(WIDTH)[shown[:, 0]]][None],
                "log_ceiling": np.zeros(1),
                "log_ceiling_scale": np.zeros(1),
                "room_type_logits": np.zeros((1, len(present(view.room_type_prior)))),
            }

        monkeypatch.setattr(ViewEncoder, "outputs", outputs)
        read = read_photographs(encoders, [hall])
        reading = read_views(encoders, read, 80.0, 4)
        by_reader = reading.by_reader
        view, constant = by_reader["view"], by_reader["constant"]
        assert view.n == constant.n == by_reader["sphere"].n == 4
        assert view.median_error == pytest.approx(-np.log(0.9), abs=0.03)
        assert view.shape_error < 0.03 < constant.shape_error
        assert present(view.classes).balanced_accuracy > 0.9
        assert constant.classes is None
        # At the azimuths of all four views, the reading of the sphere is that of the whole photograph.
        assert by_reader["sphere"].median_error == pytest.approx(read[0].measures.median_error, rel=0.5)
        results = PhotographResults(read=read, answers={}, read_views={"80": reading})
        for reader, summary in by_reader.items():
            row = f"| read_views, 80, by_reader, {reader}, shape_error | {summary.shape_error:.3f} |"
            assert row in results.markdown()
        assert results.figures()["read_views"]["80"]["by_reader"]["view"]["shape_error"] == view.shape_error
        assert f"| read_views, 80, walls_within, 2 | {reading.walls_within['2']:.3f} |" in results.markdown()

    def test_shape_error_ignores_scale(self) -> None:
        true_m, errors = np.linspace(1.0, 3.0, 9), np.array([0.1, -0.2, 0.0, 0.3, -0.1, 0.2, 0.0, 0.1, -0.3])
        measured = [measure_azimuths([true_m], np.log(true_m) + errors + scale, np.zeros(9)) for scale in (0.0, 0.7)]
        assert measured[0].shape_error == pytest.approx(measured[1].shape_error)
        assert measured[0].shape_error == pytest.approx(0.1)
        assert measured[1].median_error == pytest.approx(0.7)

    def test_predicted_openings_are_reported_and_drawn(self, root: Path) -> None:
        hall = read_annotation(root / "hall.json")
        truth = hall.classes(128)
        # The annotated door is predicted as a window.
        scores = np.eye(len(OPENING_CLASSES))[np.where(truth == OPENING_CLASSES.index("door"), 2, truth)]
        profile_m = hall.profile_m(0, 128)
        measures = measure_azimuths([profile_m], np.log(profile_m), np.full(128, -3.0), truth, scores)
        read = ReadPhotograph(photograph=hall, profile_m=profile_m, class_scores=scores, measures=measures)
        results = PhotographResults(read=[read], answers={}, foreign={"known": [0.9, 0.2, 0.4, 0.1]})
        markdown, figures = results.markdown(), results.figures()
        none, every = percent(0.0), percent(1.0)
        assert f"| door | {none} | {none} | {every} | {none} |" in markdown
        assert figures["read_as"][OPENING_CLASSES.index("door")] == [0.0, 0.0, 1.0, 0.0]
        assert "| foreign_plans, known, n | 4 |\n| foreign_plans, known, accepted | 0.250 |" in markdown
        assert figures["foreign_plans"] == {"known": {"n": 4, "accepted": 0.25}}
        for measured in ("balanced_accuracy | 0.667", "recall, wall | 1.000", "recall, door | 0.000"):
            assert f"| azimuths, classes, {measured} |" in markdown
        for measured in ("precision, wall | 1.000", "precision, door | –"):
            assert f"| azimuths, classes, {measured} |" in markdown

    @pytest.mark.slow
    def test_command_prints_measures(
        self, root: Path, tiny_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / "out"
        command = ["lab", "photographs", "--data", str(root), "--bundle", str(tiny_bundle), "--galleries", "1"]
        assert main([*command, "--workers", "0", "--out", str(out)]) == 0
        printed = capsys.readouterr().out
        figures = json.loads((out / FIGURES_FILE).read_text())
        assert figures["azimuths"]["n"] == 2
        assert figures["galleries"]["known"]["galleries"] == 2
        assert [entry["name"] for entry in figures["photographs"]] == ["den", "hall", "nook"]
        # One gallery per photograph, with the better of two outlines; poor photographs have none.
        assert [len(entry["galleries"]["unknown"]) for entry in figures["photographs"]] == [0, 1, 1]
        assert f"| azimuths, median_error | {figures['azimuths']['median_error']:.3f} |" in printed
        assert "not evaluated" in printed
        # Without galleries, walls and openings are the same.
        assert main([*command[:-1], "0", "--out", str(tmp_path / "walls")]) == 0
        walls = json.loads((tmp_path / "walls" / FIGURES_FILE).read_text())
        assert walls["azimuths"] == figures["azimuths"]
        assert walls["galleries"] == walls["foreign_plans"] == {}
        # A second run reuses the stored answers.
        assert main([*command, "--workers", "0", "--out", str(out)]) == 0
        assert json.loads((out / FIGURES_FILE).read_text()) == figures

    @pytest.mark.slow
    def test_foreign_plans_are_twenty_with_and_without_openings(self) -> None:
        plans = foreign_plans()
        assert [bool(plan.openings) for plan in plans] == [True, False] * 10
        assert sum(plan.name == "office" for plan in plans) == 10
        assert [plan.to_dict() for plan in foreign_plans()] == [plan.to_dict() for plan in plans]

    def test_poor_photographs_alone_are_refused(self, tmp_path: Path, tiny_bundle: Path) -> None:
        write(tmp_path, "den", quality="poor")
        with pytest.raises(InvalidInputError, match="all 1 photographs"):
            evaluate_photographs(tmp_path, tiny_bundle, tmp_path / "out", galleries=1, workers=0)


@pytest.mark.skipif(not REAL.exists(), reason="the annotated photographs are not here")
class TestRealPhotographs:
    def test_real_photographs_can_be_read(self) -> None:
        dataset = AnnotatedPhotographs(REAL)
        assert len(dataset.photographs) == 22
        assert sum(photograph.counts for photograph in dataset.photographs) == 19
        for key in dataset.keys(galleries=1):
            scene = dataset.load(key.scene)
            assert scene.plan.warnings == ()
            (camera,) = scene.cameras
            assert scene.plan.room_index_at(camera.position_m[None])[0] == camera.room_index

    def test_real_openings_lie_on_outlines(self) -> None:
        for photograph in AnnotatedPhotographs(REAL).photographs:
            shown = {kind for kind, _, _ in photograph.class_spans}
            assert {OPENING_CLASSES[code] for code in photograph.classes(1024)} == shown | {"wall"}
            assert {piece.kind for piece in photograph.outlines[0].openings} == shown
