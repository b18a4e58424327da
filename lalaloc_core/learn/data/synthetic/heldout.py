"""Out-of-distribution scenes for reporting only; their generator shares no code with the training generator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.learn.data.dataset import Camera, HomeScenes, Scene, Split
from lalaloc_core.learn.heldout.furnishing import LEVELS
from lalaloc_core.learn.heldout.homes import HomeKey, home_of, stands_of
from lalaloc_core.learn.heldout.renderer import HeldoutShot, depth_m, render

_DEPTH_HEIGHT = 256
_LEVEL_SHARES = (0.2, 0.25, 0.55)


@dataclass(frozen=True, kw_only=True)
class HeldoutScenes(HomeScenes):
    """Homes of the out-of-distribution generator with cameras at any heading, 1.1 to 1.8 m high.

    Camera positions are free at every furniture level. There is no training split.
    """

    split_numbers: ClassVar[dict[Split, int]] = {"validation": 1, "test": 2}

    def __post_init__(self) -> None:
        for name, minimum in (("homes", 0), ("shots_per_home", 1), ("seed", 0)):
            if getattr(self, name) < minimum:
                raise InvalidInputError(f"{name} is {getattr(self, name)}; the minimum is {minimum}")
        if self.furniture not in (None, *LEVELS):
            raise InvalidInputError(f"furniture is '{self.furniture}'; it must be one of {', '.join(LEVELS)}")

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"out-of-family homes (seed {self.seed})"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene from its name."""
        number, index = self.home_number(name)
        key = HomeKey(number, self.seed, index)
        levels = key.rng(5).choice(len(LEVELS), self.shots_per_home, p=_LEVEL_SHARES)
        cameras = tuple(
            Camera(
                name=str(k),
                position_m=stand.position_m,
                room_index=stand.room_index,
                heading=stand.heading,
                camera_height_m=stand.camera_height_m,
                photographs={
                    self.appearances[0]: HeldoutPhotograph(
                        HeldoutShot(key, self.furniture or LEVELS[levels[k]], stand, k)
                    )
                },
            )
            for k, stand in enumerate(stands_of(key, self.shots_per_home))
        )
        return Scene(name=name, plan=home_of(key).plan.plan, cameras=cameras)


@dataclass(frozen=True, eq=False)
class HeldoutPhotograph:
    """Photograph rendered on demand."""

    shot: HeldoutShot

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Render RGB pixels at the given size."""
        return render(self.shot, height, width)

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Render the distance (m) along each pixel's ray."""
        return depth_m(self.shot, _DEPTH_HEIGHT, 2 * _DEPTH_HEIGHT)
