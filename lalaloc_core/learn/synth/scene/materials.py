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
from lalaloc_core.learn.synth.scene import patterns

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
            pictures += [patterns.draw(category, PICTURE_SIZE, rng) for _ in range(_PROCEDURAL_COUNT[category])]
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
        pictures += [patterns.plain(PICTURE_SIZE, rng) for _ in range(_PLAIN_COUNT)]
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

    def sample_plain(self, rng: np.random.Generator) -> int:
        """Return the index of a random picture with little structure."""
        return int(self.plain[rng.integers(len(self.plain))])


def _read(path: Path) -> Float[np.ndarray, "128 128 3"]:
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB").resize((PICTURE_SIZE, PICTURE_SIZE)), dtype=np.float32) / 255.0
    return pixels**2.2
