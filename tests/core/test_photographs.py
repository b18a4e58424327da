"""Photographs that are trained on, with their annotations and teachers, and simulated lens and file effects."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lalaloc_core.errors import ConfigError, DatasetError
from lalaloc_core.learn.synth.augmentation import _blurred, _vignetting, optics, stretched
from lalaloc_core.learn.training.batches import Photographs
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.learn.training.photograph_targets import (
    _class_map,
    load_photographs,
    read_by_encoder,
    read_walls_and_openings,
)
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from tests.painted import painted_surfaces, wall_distance_m

ROWS, COLUMNS, WIDTH = 512, 1024, 128
WALL, DOOR, WINDOW, FLOOR, CEILING, SOFA = 1, 15, 9, 4, 6, 24
has_runtime = importlib.util.find_spec("ai_edge_litert") is not None


def by_colour(picture: np.ndarray) -> np.ndarray:
    """Segment a picture by its red channel."""
    return picture[..., 0].astype(int)


def painted() -> np.ndarray:
    """Paint a door from the floor to above the horizon, a window, and a wall whose lower part has the door's class."""
    sphere = np.full((ROWS, COLUMNS, 3), WALL, dtype=np.uint8)
    row_of = lambda elevation_deg: round((0.5 - elevation_deg / 180.0) * ROWS)  # noqa: E731
    sphere[row_of(20) : row_of(-60), 200:320] = DOOR
    sphere[row_of(20) : row_of(-20), 600:680] = WINDOW
    sphere[row_of(-60) :, 800:900] = DOOR
    return sphere


class TestMaps:
    def test_class_map_matches_the_sphere(self) -> None:
        sphere = painted()
        elevation_deg = np.array([-30.0, -10.0, 10.0])
        kind = _class_map(sphere, by_colour, np.radians(elevation_deg), COLUMNS)
        row = np.floor((0.5 - elevation_deg / 180.0) * ROWS).astype(int)
        # Nearest-neighbour sampling happens twice, so edges may be off by one.
        assert (kind == sphere[row, :, 0]).mean() > 0.99

    def test_column_shares_are_probabilities(self) -> None:
        seen = read_walls_and_openings(painted(), by_colour, WIDTH)[0]
        value = lambda column: seen[column * WIDTH // COLUMNS]  # noqa: E731
        assert value(260).tolist() == [1.0, 0.0]
        assert value(640).tolist() == [0.0, 1.0]
        # The door's class below -35 degrees does not count.
        assert value(850).tolist() == [0.0, 0.0]
        assert value(100).tolist() == [0.0, 0.0]
        assert seen.dtype == np.float32
        assert (seen.sum(axis=1) <= 1.0 + 1e-6).all()


def room(half_m: tuple[float, float], ceiling_m: float = 2.5) -> np.ndarray:
    """Paint a sphere of an empty rectangular room in the teacher's classes, seen from its centre."""
    surfaces = painted_surfaces((2.0 * half_m[0], 2.0 * half_m[1]), half_m, ceiling_m=ceiling_m, rows=ROWS)
    return np.repeat(np.array([FLOOR, WALL, CEILING])[surfaces][..., None], 3, axis=2).astype(np.uint8)


def distances(azimuth: np.ndarray, half_m: tuple[float, float]) -> np.ndarray:
    return wall_distance_m(azimuth, (2.0 * half_m[0], 2.0 * half_m[1]), half_m)


class TestWalls:
    azimuth = ((np.arange(WIDTH) + 0.5) / WIDTH - 0.5) * 2.0 * np.pi

    @pytest.mark.parametrize(("hidden", "atol"), [(slice(0), 0.05), (slice(100, 200), 0.08)])
    def test_wall_distance_comes_from_the_floor_line_or_else_the_ceiling_line(self, hidden: slice, atol: float) -> None:
        sphere = room((2.0, 3.0))
        sphere[ROWS // 2 + 20 :, hidden] = SOFA
        seen = read_walls_and_openings(sphere, by_colour, WIDTH)[1]
        np.testing.assert_allclose(seen, np.log(distances(self.azimuth, (2.0, 3.0)) / 1.5), atol=atol)

    def test_hidden_lines_give_nan(self) -> None:
        sphere = room((2.0, 3.0))
        sphere[:, 100:200] = SOFA
        # A ceiling that is not flat gives no distances.
        sloped = room((2.0, 3.0))
        for number, ceiling_m in enumerate((2.9, 3.4), start=1):
            there = np.arange(COLUMNS) // 16 % 3 == number
            sloped[: ROWS // 2, there] = room((2.0, 3.0), ceiling_m=ceiling_m)[: ROWS // 2, there]
        sloped[ROWS // 2 + 20 :, 100:200] = SOFA
        for picture in (sphere, sloped):
            unseen = np.isnan(read_walls_and_openings(picture, by_colour, WIDTH)[1])
            assert unseen[14:24].all()
            assert not unseen[30:].any()


class TestStretching:
    def test_stretched_room_has_the_stretched_size(self) -> None:
        factors, half_m = torch.tensor([[1.5, 0.75]]), (2.0, 3.0)
        azimuth = ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 2.0 * np.pi
        marks = (np.abs(azimuth) < 0.3).astype(np.float32)
        images, openings, log_distance = stretched(
            torch.from_numpy(room(half_m))[None],
            torch.from_numpy(marks)[None, :, None],
            torch.from_numpy(np.log(distances(azimuth, half_m))).float()[None],
            factors,
        )
        larger = (1.5 * half_m[0], 0.75 * half_m[1])
        np.testing.assert_allclose(log_distance[0].exp(), distances(azimuth, larger), rtol=0.02)
        assert (images[0].numpy() == room(larger)).mean() > 0.98
        edge = np.arctan(np.tan(0.3) * 1.5 / 0.75)
        np.testing.assert_array_equal(openings[0, :, 0], np.abs(azimuth) < edge)

    def test_unit_factors_change_nothing(self) -> None:
        sphere = torch.randint(0, 256, (1, 16, 32, 3), dtype=torch.uint8)
        images, _, _ = stretched(sphere, torch.zeros(1, 32, 2), torch.zeros(1, 32), torch.ones(1, 2))
        assert int((images.int() - sphere.int()).abs().max()) <= 1


class TestDrawing:
    def test_targets_are_rotated_with_the_picture(self) -> None:
        width, columns = 64, 32
        # Brightness equals the target; a smooth wave, because pictures are interpolated.
        mark = (127.0 + 100.0 * torch.sin(2.0 * torch.pi * torch.arange(width) / width)).to(torch.uint8)
        images = mark[None, None, :, None].expand(1, 8, width, 3).contiguous()
        target = (mark.float() / 256.0)[None]
        openings, one = target[..., None].expand(1, width, 3).contiguous(), torch.ones(1)
        photographs = Photographs(images, openings, torch.zeros(1, width), one.long(), one)
        drawn = photographs.draw(32, columns, torch.Generator().manual_seed(0))
        expected = (drawn.images[:, 4, :, 0].float() / 256.0).unflatten(1, (columns, 2)).mean(dim=2)
        torch.testing.assert_close(drawn.openings, expected[..., None].expand(-1, -1, 3), atol=0.03, rtol=0.0)
        brightest = drawn.images[:, 4, :, 0].argmax(dim=1)
        assert len(set(brightest.tolist())) > 10
        assert drawn.log_distance.shape == (32, columns)
        assert float(drawn.log_distance.amin()) < -0.2
        assert float(drawn.log_distance.amax()) > 0.2


class TestLoading:
    def test_photographs_and_teachers_need_each_other_and_openings(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="--teacher is for --photographs"):
            TrainingData(teachers=(tmp_path,)).load_photographs(PRESETS["tiny-trunk"])
        with pytest.raises(ConfigError, match="'ring' predicts no openings"):
            TrainingData(photographs=(tmp_path,), teachers=(tmp_path / "t",)).load_photographs(PRESETS["tiny"])
        with pytest.raises(DatasetError, match="no photographs"):
            load_photographs([tmp_path], [tmp_path / "teacher.tflite"], 32, 64)
        Image.new("RGB", (64, 32)).save(tmp_path / "room.png")
        with pytest.raises(ConfigError, match="1 photographs without annotation need one segmenter"):
            TrainingData(photographs=(tmp_path,)).load_photographs(PRESETS["tiny-trunk"])

    def test_annotations_are_exact_targets(self, tmp_path: Path) -> None:
        # A square room of two camera heights a side; a door in the middle of the wall ahead.
        corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        half = 256 * np.arctan(0.2) / (2 * np.pi)
        door = {"kind": "door", "columns": [128 - half, 128 + half], "line": [[-0.2, 1.0], [0.2, 1.0]]}
        annotation = {
            "photograph": "room.png",
            "quality": "good",
            "polygon": corners,
            "ceiling_above_camera": 0.7,
            "openings": [door],
        }
        (tmp_path / "room.json").write_text(json.dumps(annotation), encoding="utf-8")
        Image.new("RGB", (256, 128), (9, 9, 9)).save(tmp_path / "room.png")
        photographs = load_photographs([tmp_path], [], 32, 64)
        azimuth = ((np.arange(64) + 0.5) / 64 - 0.5) * 2 * np.pi
        nearest = np.maximum(abs(np.cos(azimuth)), abs(np.sin(azimuth)))
        np.testing.assert_allclose(photographs.log_distance[0].exp(), 1.0 / nearest, rtol=1e-4)
        assert photographs.openings[0, :, 0].nonzero().flatten().tolist() == [30, 31, 32, 33]
        assert not photographs.openings[0, :, 1:].any()

    def test_encoder_reads_turned_spheres_alike(self) -> None:
        torch.manual_seed(0)
        config = PRESETS["tiny-trunk"]
        encoder = TrunkImageEncoder(config.trunk, config.ring).eval()
        sphere = torch.randint(0, 256, (1, *config.image_size, 3), dtype=torch.uint8)
        width = config.image_size[1]
        openings, log_distance = read_by_encoder(encoder, sphere, width)
        shifted = read_by_encoder(encoder, sphere.roll(width // 4, 2), width)
        torch.testing.assert_close(shifted[0], openings.roll(width // 4, 1))
        torch.testing.assert_close(shifted[1], log_distance.roll(width // 4, 1))
        mirrored = read_by_encoder(encoder, sphere.flip(2), width)
        torch.testing.assert_close(mirrored[1], log_distance.flip(1))

    @pytest.mark.skipif(not has_runtime, reason="ai-edge-litert is not installed")
    def test_invalid_teacher_is_refused(self, tmp_path: Path) -> None:
        Image.new("RGB", (64, 32)).save(tmp_path / "room.png")
        (tmp_path / "teacher.tflite").write_bytes(b"no model")
        with pytest.raises(ConfigError, match=r"teacher\.tflite"):
            load_photographs([tmp_path], [tmp_path / "teacher.tflite"], 32, 64)


class TestOptics:
    def pictures(self) -> torch.Tensor:
        return torch.rand(16, 16, 32, 3, generator=torch.Generator().manual_seed(2)) * 255.0

    def test_optics_change_most_pictures_unless_their_strength_is_zero(self) -> None:
        changed = optics(self.pictures(), 1.0, torch.Generator().manual_seed(0))
        assert torch.equal(changed, optics(self.pictures(), 1.0, torch.Generator().manual_seed(0)))
        assert 0.0 <= changed.min() <= changed.max() <= 255.0
        differs = (changed - self.pictures()).abs().amax(dim=(1, 2, 3)) > 1.0
        assert int(differs.sum()) > 8
        changed = optics(self.pictures(), 0.0, torch.Generator().manual_seed(0))
        torch.testing.assert_close(changed, self.pictures(), atol=1e-3, rtol=0.0)

    @pytest.mark.parametrize("columns", [1, 13])
    def test_blur_wraps_around_the_horizon(self, columns: int) -> None:
        pictures = self.pictures()
        torch.testing.assert_close(_blurred(pictures.roll(columns, 2)), _blurred(pictures).roll(columns, 2))

    def test_lens_seams_are_darker(self) -> None:
        seam = torch.tensor([0.5, 2.0])
        assert torch.equal(_vignetting(64, torch.zeros(2), torch.zeros(2), seam), torch.ones(2, 1, 64, 1))
        gain = _vignetting(64, torch.full((2,), 0.3), torch.zeros(2), seam)
        assert gain.amin() == pytest.approx(0.7, abs=0.01)
        assert gain.amax() == pytest.approx(1.0, abs=0.01)
        stepped = _vignetting(64, torch.zeros(2), torch.full((2,), 0.1), seam)
        assert sorted({round(value, 3) for value in stepped.flatten().tolist()}) == [0.9, 1.1]
