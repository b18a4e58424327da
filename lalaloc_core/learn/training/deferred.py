"""Deferred rendering: worker processes send scenes instead of pixels, and the training device renders them.

A worker builds homes and scenes in Python and decides for every row of a batch which scene it shows, its rotation and
its mirroring. The device renders each scene at its first use, caches the sphere until its last use, and rotates whole
batches at once. A scene has about 15 kB, its sphere six times as much.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.render_scene import RenderScene
from lalaloc_core.learn.training.batches import Batch, Rotation, stack_rows

Row = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class DeferredScene:
    """A scene to be rendered later, with a number that is unique within the run."""

    number: int
    scene: RenderScene


# A row of a batch: the sphere to render, its rotation, and the other values.
DeferredRow = tuple[DeferredScene, Rotation, Row]


@dataclass(frozen=True, eq=False, kw_only=True)
class DeferredBatch:
    """A batch without pixels; `scenes` are those used for the first time, `evicted` those that no later batch uses."""

    rest: Batch
    number: tuple[int, ...]
    shift: Int[Tensor, "b"]
    mirrored: Bool[Tensor, "b"]
    scenes: dict[int, RenderScene]
    evicted: tuple[int, ...]


class DeferredBatcher:
    """Packer of rows into batches without pixels; every scene is used `uses` times in total."""

    def __init__(self, uses: int) -> None:
        self._uses = uses
        self._left: dict[int, int] = {}
        self._sent: set[int] = set()
        self._evicted: list[int] = []

    def pack(self, rows: list[DeferredRow]) -> DeferredBatch:
        """Pack rows into a batch, with the scenes that it uses for the first time."""
        scenes = {sphere.number: sphere.scene for sphere, _, _ in rows if sphere.number not in self._sent}
        self._sent |= scenes.keys()
        for sphere, _, _ in rows:
            self.use(sphere)
        evicted, self._evicted = tuple(self._evicted), []
        return DeferredBatch(
            rest=stack_rows([rest for _, _, rest in rows]),
            number=tuple(sphere.number for sphere, _, _ in rows),
            shift=torch.tensor([turn.shift for _, turn, _ in rows]),
            mirrored=torch.tensor([turn.mirrored for _, turn, _ in rows]),
            scenes=scenes,
            evicted=evicted,
        )

    def use(self, sphere: DeferredScene) -> None:
        """Count one use of a scene, also of one that yields no row."""
        left = self._left.pop(sphere.number, self._uses) - 1
        if left:
            self._left[sphere.number] = left
        elif sphere.number in self._sent:
            self._sent.remove(sphere.number)
            self._evicted.append(sphere.number)


class DeferredRenderer:
    """Renderer of batches without pixels, on its own device."""

    def __init__(self, renderer: SphereRenderer) -> None:
        self._renderer = renderer
        self._images: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._images)

    def render_batches(self, batches: Iterable[DeferredBatch]) -> Iterator[Batch]:
        """Yield each batch with `image` (b, h, w, 4) uint8 on the device; the last channel tells walls."""
        for batch in batches:
            if batch.scenes:
                images = self._renderer.render_scenes(list(batch.scenes.values()), walls=True)
                self._images.update(zip(batch.scenes, images, strict=True))
            shown = torch.stack([self._images[number] for number in batch.number])
            for number in batch.evicted:
                del self._images[number]
            yield batch.rest | {"image": rotate_images(shown, batch.shift, batch.mirrored)}


def rotate_images(
    images: UInt8[Tensor, "b h w c"], shift: Int[Tensor, "b"], mirrored: Bool[Tensor, "b"]
) -> UInt8[Tensor, "b h w c"]:
    """Roll each sphere by `shift` columns to the right, then mirror it if asked, like `Rotation.picture`."""
    width = images.shape[2]
    column = torch.arange(width, device=images.device)
    source = torch.where(mirrored.to(images.device)[:, None], width - 1 - column, column)
    source = (source - shift.to(images.device)[:, None]) % width
    return torch.take_along_dim(images, source[:, None, :, None], dim=2)
