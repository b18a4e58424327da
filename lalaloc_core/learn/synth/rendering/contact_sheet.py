"""Contact sheet of synthetic panoramas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lalaloc_core.learn.synth.furniture.furnish import FurnitureLevel
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer, sample_shots
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary

_COLUMNS, _ROWS = 4, 4


def contact_sheet(path: Path, rng: np.random.Generator, textures: Path | None = None, *, height: int = 256) -> None:
    """Write a sheet of 16 panoramas of 16 homes, from empty to full.

    `textures` is a folder of material pictures, and `height` that of one panorama in pixels.
    """
    renderer = PanoramaRenderer(MaterialLibrary.create(rng, textures), height=height, width=2 * height, supersample=2)
    levels: list[FurnitureLevel] = ["empty", "simple", "full", "full"] * _ROWS
    shots = [sample_shots(generate_home(rng), 1, rng, level)[0] for level in levels]
    pictures = renderer.render(shots).numpy()
    rows = pictures.reshape(_ROWS, _COLUMNS, height, 2 * height, 3).swapaxes(1, 2)
    Image.fromarray(rows.reshape(_ROWS * height, _COLUMNS * 2 * height, 3)).save(path, quality=85)
