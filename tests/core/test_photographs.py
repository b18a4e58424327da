"""Photographs without labels, and lenses and files that pictures went through."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lalaloc_core.errors import ConfigError, DatasetError
from lalaloc_core.training.config import PRESETS
from lalaloc_core.training.data import TrainingData
from lalaloc_core.training.photographs import Photographs, _class_map, _seen, load_photographs
from lalaloc_core.training.photometric import _blurred, _lenses, optics

ROWS, COLUMNS, WIDTH = 512, 1024, 128
WALL, DOOR, WINDOW = 1, 15, 9
has_runtime = importlib.util.find_spec("ai_edge_litert") is not None


def by_colour(picture: np.ndarray) -> np.ndarray:
    """A segmenter that reads the class from the red channel."""
    return picture[..., 0].astype(int)


def painted() -> np.ndarray:
    """A door from the floor to above the horizon, a window about it, and a wall whose lower part is a door's colour."""
    panorama = np.full((ROWS, COLUMNS, 3), WALL, dtype=np.uint8)
    row_of = lambda elevation_deg: round((0.5 - elevation_deg / 180.0) * ROWS)  # noqa: E731
    panorama[row_of(20) : row_of(-60), 200:320] = DOOR
    panorama[row_of(20) : row_of(-20), 600:680] = WINDOW
    panorama[row_of(-60) :, 800:900] = DOOR
    return panorama


class TestMaps:
    def test_every_direction_has_the_class_of_what_is_seen_there(self) -> None:
        panorama = painted()
        elevation_deg = np.array([-30.0, -10.0, 10.0])
        kind = _class_map(panorama, by_colour, np.radians(elevation_deg), COLUMNS)
        row = np.floor((0.5 - elevation_deg / 180.0) * ROWS).astype(int)
        # Nearest pixels of nearest pixels: edges may be off by one.
        assert (kind == panorama[row, :, 0]).mean() > 0.99

    def test_shares_of_columns_serve_as_probabilities(self) -> None:
        seen = _seen(painted(), by_colour, WIDTH)
        at = lambda column: seen[column * WIDTH // COLUMNS]  # noqa: E731
        assert at(260).tolist() == [1.0, 0.0]
        assert at(640).tolist() == [0.0, 1.0]
        # A door's colour below -35 degrees is no door.
        assert at(850).tolist() == [0.0, 0.0]
        assert at(100).tolist() == [0.0, 0.0]
        assert seen.dtype == np.float32
        assert (seen.sum(axis=1) <= 1.0 + 1e-6).all()


class TestDrawing:
    def test_what_is_taught_is_turned_and_mirrored_with_the_picture(self) -> None:
        width, columns = 16, 8
        mark = torch.arange(width, dtype=torch.uint8)
        images = mark[None, None, :, None].expand(1, 4, width, 3).contiguous()
        photographs = Photographs(images, (mark.float() / width)[None, :, None].expand(1, width, 2).contiguous())
        shown, taught = photographs.draw(32, columns, torch.Generator().manual_seed(0))
        expected = (shown[:, 0, :, 0].float() / width).unflatten(1, (columns, 2)).mean(dim=2)
        torch.testing.assert_close(taught, expected[..., None].expand(-1, -1, 2))
        starts = {tuple(row.tolist()) for row in shown[:, 0, :, 0]}
        assert len(starts) > 16
        assert any(row[1] == (row[0] - 1) % width for row in starts)


class TestLoading:
    def test_photographs_and_teacher_are_given_together(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="together"):
            TrainingData(photographs=tmp_path).load_photographs(PRESETS["tiny-trunk"])

    def test_an_architecture_without_openings_learns_nothing_from_them(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="'ring' tells no openings"):
            TrainingData(photographs=tmp_path, teacher=tmp_path / "t").load_photographs(PRESETS["tiny"])

    def test_a_folder_without_photographs_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match="no photographs"):
            load_photographs(tmp_path, tmp_path / "teacher.tflite", 32, 64)

    @pytest.mark.skipif(not has_runtime, reason="ai-edge-litert is not installed")
    def test_a_teacher_that_is_none_is_named(self, tmp_path: Path) -> None:
        Image.new("RGB", (64, 32)).save(tmp_path / "room.png")
        (tmp_path / "teacher.tflite").write_bytes(b"no model")
        with pytest.raises(ConfigError, match=r"teacher\.tflite"):
            load_photographs(tmp_path, tmp_path / "teacher.tflite", 32, 64)


class TestOptics:
    def pictures(self) -> torch.Tensor:
        return torch.rand(16, 16, 32, 3, generator=torch.Generator().manual_seed(2)) * 255.0

    def test_nothing_changes_without_strength(self) -> None:
        changed = optics(self.pictures(), 0.0, torch.Generator().manual_seed(0))
        torch.testing.assert_close(changed, self.pictures(), atol=1e-3, rtol=0.0)

    def test_most_pictures_change_and_stay_pictures(self) -> None:
        changed = optics(self.pictures(), 1.0, torch.Generator().manual_seed(0))
        again = optics(self.pictures(), 1.0, torch.Generator().manual_seed(0))
        assert torch.equal(changed, again)
        assert 0.0 <= changed.min() <= changed.max() <= 255.0
        differs = (changed - self.pictures()).abs().amax(dim=(1, 2, 3)) > 1.0
        assert int(differs.sum()) > 8

    @pytest.mark.parametrize("columns", [1, 13])
    def test_blur_goes_around_the_horizon(self, columns: int) -> None:
        pictures = self.pictures()
        torch.testing.assert_close(_blurred(pictures.roll(columns, 2)), _blurred(pictures).roll(columns, 2))

    def test_lenses_darken_where_they_meet_and_leave_a_picture_without_them_alone(self) -> None:
        seam = torch.tensor([0.5, 2.0])
        assert torch.equal(_lenses(64, torch.zeros(2), torch.zeros(2), seam), torch.ones(2, 1, 64, 1))
        gain = _lenses(64, torch.full((2,), 0.3), torch.zeros(2), seam)
        assert gain.amin() == pytest.approx(0.7, abs=0.01)
        assert gain.amax() == pytest.approx(1.0, abs=0.01)
        stepped = _lenses(64, torch.zeros(2), torch.full((2,), 0.1), seam)
        assert sorted({round(value, 3) for value in stepped.flatten().tolist()}) == [0.9, 1.1]
