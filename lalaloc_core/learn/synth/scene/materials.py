"""Pictures of materials: procedural ones, and optionally a folder of photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image

from lalaloc_core.errors import InvalidInputError

Picture = Float[np.ndarray, "size size 3"]


def draw_pattern(category: str, size: int, rng: np.random.Generator) -> Picture:
    """Return a random picture for a category of surfaces."""
    choices = {
        "floor": (_planks, _planks, _tiles, _tiles, _carpet, _marble),
        "wall": (_plaster, _plaster, _plaster, _wallpaper, _tiles, _bricks),
        "ceiling": (_plaster, _plaster, _panels),
        "furniture": (_wood, _wood, _weave, _plaster, _stripes, _marble),
    }[category]
    picture = choices[int(rng.integers(len(choices)))](size, rng)
    return np.clip(picture, 0.01, 0.95)


def plain_picture(size: int, rng: np.random.Generator) -> Picture:
    """Return a nearly uniform picture: paint, plastic, metal."""
    return _shade(0.6 * np.ones(3), 0.008 * smooth_noise(size, rng, 1.5) + 0.012 * smooth_noise(size, rng, 14.0))


def smooth_noise(size: int, rng: np.random.Generator, scale: float, stretch: float = 1.0) -> Float[np.ndarray, "s s"]:
    """Return periodic noise of unit deviation, with blobs of `scale` pixels, longer along y by `stretch`."""
    spectrum = np.fft.rfft2(rng.normal(size=(size, size)))
    fy, fx = np.fft.fftfreq(size)[:, None] * stretch, np.fft.rfftfreq(size)[None]
    spectrum = spectrum * np.exp(-2.0 * (scale**2) * (fx**2 + fy**2))
    noise = np.fft.irfft2(spectrum, s=(size, size))
    noise = noise - noise.mean()
    return noise / (noise.std() + 1e-9)


def _tone(rng: np.random.Generator, low: float, high: float, colourful: float = 0.1) -> Float[np.ndarray, "3"]:
    """Return a mostly warm colour of a given brightness."""
    level = rng.uniform(low, high)
    warmth = rng.normal(0.3, 0.6) * colourful
    green = rng.normal(0.0, 0.3) * colourful
    return level * np.array([1.0 + warmth, 1.0 + green, 1.0 - warmth])


def _wood_tone(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    level = np.exp(rng.uniform(np.log(0.05), np.log(0.5)))
    warmth = rng.uniform(0.05, 0.45)
    return level * np.array([1.0 + warmth, 1.0, 1.0 - warmth])


def _shade(base: np.ndarray, relief: np.ndarray) -> Picture:
    return base * np.clip(1.0 + relief[..., None], 0.2, 1.9)


def _wood(size: int, rng: np.random.Generator) -> Picture:
    grain = 0.6 * smooth_noise(size, rng, 1.2, 12.0) + 0.4 * smooth_noise(size, rng, 5.0, 8.0)
    return _shade(_wood_tone(rng), rng.uniform(0.03, 0.16) * grain)


def _planks(size: int, rng: np.random.Generator) -> Picture:
    rows = int(rng.choice([4, 6, 8, 10]))
    base = _wood_tone(rng)
    row = np.arange(size) * rows // size
    joint = rng.uniform(0, size, rows)
    y = (np.arange(size)[:, None] + joint[row][None]) % size
    plank = (y * int(rng.integers(1, 3)) // size).astype(int) * rows + row[None]
    tint = rng.normal(0.0, rng.uniform(0.03, 0.16), plank.max() + 1)[plank]
    grain = rng.uniform(0.03, 0.12) * smooth_noise(size, rng, 1.0, 12.0)
    gap = (np.arange(size) % (size / rows) < 1.0)[None] | (np.diff(plank, axis=0, prepend=plank[-1:]) != 0)
    return _shade(base, tint + grain - rng.uniform(0.1, 0.5) * gap)


def _grid_lines(size: int, cells: int, width: float) -> Float[np.ndarray, "s s"]:
    line = (np.arange(size) % (size / cells)) < width
    return (line[:, None] | line[None]).astype(float)


def _tiles(size: int, rng: np.random.Generator) -> Picture:
    cells = int(rng.choice([1, 2, 2, 3, 4, 8]))
    base = _tone(rng, 0.08, 0.8, 0.15)
    number = np.arange(size) * cells // size
    tile = number[:, None] * cells + number[None]
    relief = rng.normal(0.0, 0.05, cells * cells)[tile] + 0.06 * smooth_noise(size, rng, 6.0) * rng.random()
    if rng.random() < 0.15:
        relief += 0.6 * (((number[:, None] + number[None]) % 2) - 0.5)
    grout = _grid_lines(size, cells, 1.5)[..., None]
    grout_tone = _tone(rng, 0.1, 0.7, 0.05)
    return _shade(base, relief) * (1.0 - grout) + grout_tone * grout


def _carpet(size: int, rng: np.random.Generator) -> Picture:
    fuzz = rng.uniform(0.08, 0.25) * smooth_noise(size, rng, 0.7) + 0.06 * smooth_noise(size, rng, 10.0)
    return _shade(_tone(rng, 0.05, 0.6, 0.25), fuzz)


def _marble(size: int, rng: np.random.Generator) -> Picture:
    veins = 1.0 - np.abs(np.tanh(1.5 * smooth_noise(size, rng, 9.0)))
    speckle = 0.1 * smooth_noise(size, rng, 1.0)
    strength = rng.uniform(-0.35, 0.25)
    return _shade(_tone(rng, 0.1, 0.8, 0.12), strength * veins + rng.random() * speckle)


def _plaster(size: int, rng: np.random.Generator) -> Picture:
    relief = rng.uniform(0.0, 0.05) * smooth_noise(size, rng, 1.5) + rng.uniform(0.0, 0.05) * smooth_noise(
        size, rng, 12.0
    )
    return _shade(_tone(rng, 0.3, 0.85, 0.08), relief)


def _wallpaper(size: int, rng: np.random.Generator) -> Picture:
    period = int(rng.choice([4, 8, 16]))
    phase = np.arange(size) / size * period * 2 * np.pi
    wave = np.sin(phase)[None] * np.ones((size, 1))
    if rng.random() < 0.5:
        wave = wave * np.sin(phase)[:, None]
    wave = np.tanh(wave * rng.uniform(0.5, 6.0))
    return _shade(_tone(rng, 0.2, 0.75, 0.25), rng.uniform(0.03, 0.25) * wave)


def _bricks(size: int, rng: np.random.Generator) -> Picture:
    rows, columns = 12, 4
    row = np.arange(size) * rows // size
    shift = (row % 2) * size // (2 * columns)
    x = (np.arange(size)[None] + shift[:, None]) % size
    brick = row[:, None] * columns + x * columns // size
    mortar = ((np.arange(size) % (size / rows)) < 1.5)[:, None] | ((x % (size // columns)) < 1.5)
    base = _tone(rng, 0.1, 0.7, 0.3 * rng.random())
    face = _shade(base, rng.normal(0.0, 0.12, rows * columns)[brick] + 0.08 * smooth_noise(size, rng, 1.5))
    return np.where(mortar[..., None], _tone(rng, 0.3, 0.7, 0.05), face)


def _panels(size: int, rng: np.random.Generator) -> Picture:
    lines = _grid_lines(size, int(rng.choice([1, 2])), 2.0)
    return _shade(_tone(rng, 0.5, 0.85, 0.05), -0.3 * lines + 0.03 * smooth_noise(size, rng, 1.0))


def _weave(size: int, rng: np.random.Generator) -> Picture:
    phase = np.arange(size) / size * 2 * np.pi * int(rng.choice([16, 32]))
    weave = np.sin(phase)[:, None] * np.sin(phase)[None]
    return _shade(_tone(rng, 0.04, 0.65, 0.5), 0.08 * weave + 0.07 * smooth_noise(size, rng, 4.0))


def _stripes(size: int, rng: np.random.Generator) -> Picture:
    phase = np.arange(size) / size * int(rng.choice([4, 8, 16]))
    stripe = (phase % 1.0 < rng.uniform(0.2, 0.8))[None, :, None]
    return np.where(stripe, _tone(rng, 0.05, 0.7, 0.5), _tone(rng, 0.05, 0.7, 0.5)) * np.ones((size, 1, 1))


MaterialCategory = Literal["floor", "wall", "ceiling", "furniture"]
CATEGORIES: tuple[MaterialCategory, ...] = ("floor", "wall", "ceiling", "furniture")
PICTURE_SIZE = 128

_PROCEDURAL_COUNT: dict[MaterialCategory, int] = {"floor": 40, "wall": 24, "ceiling": 8, "furniture": 32}
_PLAIN_COUNT = 4


@dataclass(frozen=True, eq=False)
class MaterialLibrary:
    """Tileable pictures of materials, each about one metre across.

    Attributes:
        pictures: (m, 128, 128, 3), linear-light colour in 0..1.
        procedural: per category, indices of the generated pictures.
        photographs: per category and material, indices of the pictures read from a folder; can be empty.
        plain: indices of pictures with little structure, for paint, plastic and metal.
    """

    pictures: Float[torch.Tensor, "m 128 128 3"]
    procedural: Mapping[MaterialCategory, Int[np.ndarray, "_"]]
    photographs: Mapping[MaterialCategory, Sequence[Int[np.ndarray, "_"]]]
    plain: Int[np.ndarray, "_"]

    @classmethod
    def create(cls, rng: np.random.Generator, textures: Path | None = None) -> MaterialLibrary:
        """Generate pictures, and read those below `textures`: <category>/<material>/<picture>.jpg."""
        pictures: list[np.ndarray] = []
        procedural, photographs = {}, {}
        for category in CATEGORIES:
            first = len(pictures)
            pictures += [draw_pattern(category, PICTURE_SIZE, rng) for _ in range(_PROCEDURAL_COUNT[category])]
            procedural[category] = np.arange(first, len(pictures))
            photographs[category] = []
            for folder in sorted((textures / category).glob("*/")) if textures is not None else []:
                found = [_read(path) for path in sorted(folder.glob("*.jpg"))]
                if found:
                    photographs[category].append(np.arange(len(pictures), len(pictures) + len(found)))
                    pictures += found
        if textures is not None and not any(photographs.values()):
            raise InvalidInputError(
                f"'{textures}' contains no pictures; a textures folder has <category>/<material>/*.jpg"
            )
        plain = np.arange(len(pictures), len(pictures) + _PLAIN_COUNT)
        pictures += [plain_picture(PICTURE_SIZE, rng) for _ in range(_PLAIN_COUNT)]
        return cls(torch.from_numpy(np.stack(pictures).astype(np.float32)), procedural, photographs, plain)

    @cached_property
    def mean_colours(self) -> Float[np.ndarray, "m 3"]:
        """Return the mean linear colour of every picture."""
        return self.pictures.mean(dim=(1, 2)).numpy().astype(np.float64)

    def sample(self, category: MaterialCategory, rng: np.random.Generator) -> int:
        """Return the index of a random picture: generated or, with even chances, a photograph if there are any."""
        photographs = self.photographs[category]
        source = self.procedural[category]
        if photographs and rng.random() < 0.5:
            # All materials alike, however many pictures there are of each.
            source = photographs[int(rng.integers(len(photographs)))]
        return int(source[rng.integers(len(source))])


def _read(path: Path) -> Float[np.ndarray, "128 128 3"]:
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB").resize((PICTURE_SIZE, PICTURE_SIZE)), dtype=np.float32) / 255.0
    return pixels**2.2
