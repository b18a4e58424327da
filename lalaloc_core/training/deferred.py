"""Panoramas that worker processes stage and the training device photographs: scenes travel, pixels do not.

A worker builds homes and scenes, which is Python, and decides what every row of a batch shows: picture number so and
so, turned and mirrored like this. The device renders each scene once, when its number first comes up, keeps the picture
for as long as rows will ask for it, and turns whole batches at once. A scene has some 15 kB, its panorama six times as
much.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from lalaloc_core.synth.panorama import PanoramaRenderer
from lalaloc_core.synth.render_scene import Scene
from lalaloc_core.training.batches import Batch, stacked
from lalaloc_core.training.turning import Turn

Row = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class Staged:
    """A scene that has not been photographed, under a number of its own among all that are trained on."""

    number: int
    scene: Scene


@dataclass(frozen=True, eq=False)
class StagedRow:
    """A row of a batch: a staged panorama, how it is turned, and everything else."""

    staged: Staged
    turn: Turn
    rest: Row


@dataclass(frozen=True, eq=False, kw_only=True)
class Negative:
    """A batch without pixels.

    Attributes:
        rest: the batch without `image`.
        number: which picture each row shows.
        shift: by how many columns it is rolled to the right.
        mirrored: whether it is mirrored after that.
        scenes: those that come up for the first time, by number.
        spent: numbers that no later batch asks for.
    """

    rest: Batch
    number: tuple[int, ...]
    shift: Int[Tensor, "b"]
    mirrored: Bool[Tensor, "b"]
    scenes: dict[int, Scene]
    spent: tuple[int, ...]


class Negatives:
    """Packs rows into batches without pixels; every staged scene is used `uses` times in all."""

    def __init__(self, uses: int) -> None:
        self._uses = uses
        self._left: dict[int, int] = {}
        self._shown: set[int] = set()
        self._spent: list[int] = []

    def lose(self, staged: Staged) -> None:
        """One use of a scene came to nothing."""
        self._use(staged.number)

    def pack(self, rows: list[StagedRow]) -> Negative:
        """A batch of rows; the scenes that it shows first travel with it."""
        scenes = {row.staged.number: row.staged.scene for row in rows if row.staged.number not in self._shown}
        self._shown |= scenes.keys()
        for row in rows:
            self._use(row.staged.number)
        spent, self._spent = tuple(self._spent), []
        return Negative(
            rest=stacked([row.rest for row in rows]),
            number=tuple(row.staged.number for row in rows),
            shift=torch.tensor([row.turn.shift for row in rows]),
            mirrored=torch.tensor([row.turn.mirrored for row in rows]),
            scenes=scenes,
            spent=spent,
        )

    def _use(self, number: int) -> None:
        left = self._left.pop(number, self._uses) - 1
        if left:
            self._left[number] = left
        elif number in self._shown:
            self._shown.remove(number)
            self._spent.append(number)


class Darkroom:
    """Turns batches without pixels into batches with panoramas, on the renderer's device."""

    def __init__(self, renderer: PanoramaRenderer) -> None:
        self._renderer = renderer
        self._pictures: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._pictures)

    def developed(self, batches: Iterable[Negative]) -> Iterator[Batch]:
        """Each batch with `image` (b, h, w, 3) uint8 on the device."""
        for negative in batches:
            yield self._develop(negative)

    def _develop(self, negative: Negative) -> Batch:
        if negative.scenes:
            images = self._renderer.render_scenes(list(negative.scenes.values()))
            self._pictures.update(zip(negative.scenes, images, strict=True))
        shown = torch.stack([self._pictures[number] for number in negative.number])
        for number in negative.spent:
            del self._pictures[number]
        return negative.rest | {"image": turned(shown, negative.shift, negative.mirrored)}


def turned(
    images: UInt8[Tensor, "b h w 3"], shift: Int[Tensor, "b"], mirrored: Bool[Tensor, "b"]
) -> UInt8[Tensor, "b h w 3"]:
    """Panoramas, each rolled by `shift` columns to the right and then mirrored or not, as `Turn.picture` does."""
    width = images.shape[2]
    column = torch.arange(width, device=images.device)
    source = torch.where(mirrored.to(images.device)[:, None], width - 1 - column, column)
    source = (source - shift.to(images.device)[:, None]) % width
    return torch.take_along_dim(images, source[:, None, :, None], dim=2)
