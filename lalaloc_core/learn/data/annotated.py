"""Annotated photographs as a data set: each is localised in galleries, plans of its own room among similar ones."""

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
from lalaloc_core.learn.dataset_names import GALLERIES

_SCENE = re.compile(r"(?P<photograph>.+)-(?P<gallery>\d+)(?P<alternative>-alternative)?")


@dataclass(frozen=True)
class GalleryKey:
    """Key of a scene: the photograph, the number of its gallery, and the outline used for its own room."""

    photograph: str
    gallery: int
    outline: int

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return f"{self.photograph}-{self.gallery}" + ("-alternative" if self.outline else "")

    @classmethod
    def from_scene(cls, name: str) -> GalleryKey | None:
        """Parse a scene's name; return None if it is not the name of a gallery."""
        match = _SCENE.fullmatch(name)
        if match is None:
            return None
        return cls(match["photograph"], int(match["gallery"]), int(match["alternative"] is not None))


@dataclass(frozen=True)
class AnnotatedPhotographs:
    """Folder of annotated photographs; all are test scenes.

    A photograph with an alternative outline has each gallery twice, once per outline, with the same other rooms.
    Photographs of poor quality have no gallery, but their rooms occur in galleries of others.
    """

    root: Path

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"annotated photographs in galleries ({self.root.resolve().name})"

    appearances = (Appearance(),)

    @cached_property
    def photographs(self) -> tuple[AnnotatedPhotograph, ...]:
        """All photographs, sorted by name."""
        photographs = tuple(read_annotation(path) for path in annotation_files(self.root))
        if not photographs:
            raise DatasetError("the folder has no annotated photographs", path=self.root)
        return photographs

    def keys(self, galleries: int = GALLERIES) -> list[GalleryKey]:
        """Return the keys of the scenes: the first gallery of every photograph, then the second ones, and so on."""
        return [
            GalleryKey(photograph.name, gallery, outline)
            for gallery in range(galleries)
            for photograph in self.photographs
            if photograph.counts
            for outline in range(len(photograph.outlines))
        ]

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of the galleries; only the test split has some."""
        return [key.scene for key in self.keys()] if split == "test" else []

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Build the gallery of a scene's name."""
        key = GalleryKey.from_scene(name)
        photograph = next((p for p in self.photographs if key is not None and p.name == key.photograph), None)
        if key is None or photograph is None or key.outline >= len(photograph.outlines):
            raise DatasetError("no such gallery of an annotated photograph", scene=name, path=self.root)
        others = [other.outlines[0] for other in self.photographs if other is not photograph]
        rng = np.random.default_rng([zlib.crc32(photograph.name.encode()), key.gallery])
        own = photograph.outlines[key.outline]
        gallery = build_gallery(own, others, CAMERA_HEIGHT_M, rng, like=photograph.outlines[0])
        camera = Camera(
            name=photograph.name,
            position_m=gallery.position_m,
            room_index=gallery.room_index,
            heading=gallery.heading,
            camera_height_m=CAMERA_HEIGHT_M,
            photographs={Appearance(): photograph.photograph},
        )
        return Scene(name=name, plan=gallery.plan, cameras=(camera,))


def annotation_files(root: Path) -> list[Path]:
    """Return the annotation files of a folder, sorted by name."""
    return [path for path in sorted(root.glob("*.json")) if is_annotation(path)]
