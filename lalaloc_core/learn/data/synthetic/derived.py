"""What data sets have in common that ask generated homes otherwise than they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from lalaloc_core.learn.data.dataset import Appearance, Camera, Split
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes


@dataclass(frozen=True)
class DerivedScenes:
    """The scenes of generated homes, by the same names; `load` is where they differ, and `asked` says how."""

    homes: GeneratedScenes
    asked: ClassVar[str]

    @property
    def description(self) -> str:
        return f"{self.homes.description}, {self.asked}"

    @property
    def appearances(self) -> Sequence[Appearance]:
        return self.homes.appearances

    def scenes(self, split: Split) -> Sequence[str]:
        return self.homes.scenes(split)


def seed_of(camera: Camera) -> int:
    """A seed for what is random about a camera's photograph, from where it stands."""
    return int(1e3 * abs(camera.position_m).sum())
