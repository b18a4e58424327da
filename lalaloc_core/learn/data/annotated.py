"""Annotated photographs as a data set: each is asked for in galleries, plans of its own room among others like it."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, is_annotation, read_annotation
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene, Split
from lalaloc_core.learn.data.room_gallery import build_gallery

GALLERIES = 3
_SCENE = re.compile(r"(?P<photograph>.+)-(?P<gallery>\d+)(?P<alternative>-alternative)?")


@dataclass(frozen=True)
class GalleryKey:
    """Which question a scene is: the photograph, the number of its gallery, and which outline is its own room's."""

    photograph: str
    gallery: int
    outline: int

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return f"{self.photograph}-{self.gallery}" + ("-alternative" if self.outline else "")

    @classmethod
    def of_scene(cls, name: str) -> GalleryKey | None:
        """The key that a scene's name stands for; None where it is none."""
        found = _SCENE.fullmatch(name)
        if found is None:
            return None
        return cls(found["photograph"], int(found["gallery"]), int(found["alternative"] is not None))


@dataclass(frozen=True)
class AnnotatedPhotographs:
    """A folder of annotated photographs; all are test scenes, for nothing but measuring.

    A photograph with an alternative outline has each gallery twice, once with either; the others are the same.
    Photographs of poor quality are not asked for, but their rooms are among the others.
    """

    root: Path

    @property
    def description(self) -> str:
        return f"annotated photographs in galleries ({self.root.resolve().name})"

    @property
    def appearances(self) -> Sequence[Appearance]:
        return (Appearance(),)

    @cached_property
    def photographs(self) -> tuple[AnnotatedPhotograph, ...]:
        """All of them, in the order of names.

        Raises:
            DatasetError: one cannot be read, or there are none.
        """
        found = tuple(read_annotation(path) for path in annotation_files(self.root))
        if not found:
            raise DatasetError("there are no annotated photographs", path=self.root)
        return found

    def keys(self, galleries: int = GALLERIES) -> list[GalleryKey]:
        """The questions: the first gallery of every photograph, then the second ones, and so on."""
        return [
            GalleryKey(one.name, gallery, outline)
            for gallery in range(galleries)
            for one in self.photographs
            if one.counts
            for outline in range(len(one.outlines))
        ]

    def scenes(self, split: Split) -> Sequence[str]:
        return [key.scene for key in self.keys()] if split == "test" else []

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        key = GalleryKey.of_scene(name)
        one = next((p for p in self.photographs if key is not None and p.name == key.photograph), None)
        if key is None or one is None or key.outline >= len(one.outlines):
            raise DatasetError("no such gallery of an annotated photograph", scene=name, path=self.root)
        others = [other.outlines[0] for other in self.photographs if other is not one]
        rng = np.random.default_rng([zlib.crc32(one.name.encode()), key.gallery])
        gallery = build_gallery(one.outlines[key.outline], others, CAMERA_HEIGHT_M, rng, like=one.outlines[0])
        camera = Camera(
            name=one.name,
            position_m=gallery.position_m,
            room_index=gallery.room_index,
            heading=gallery.heading,
            camera_height_m=CAMERA_HEIGHT_M,
            photographs={Appearance(): one.photograph},
        )
        return Scene(name=name, plan=gallery.plan, cameras=(camera,))


def annotation_files(root: Path) -> list[Path]:
    """The annotations in a folder, in the order of names."""
    return [path for path in sorted(root.glob("*.json")) if is_annotation(path)]
