"""Photographs of procedural homes: the sphere renderer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lalaloc_core.conventions import TWO_PI, column_azimuths, row_elevations
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.synth.camera import develop, without_stitching
from lalaloc_core.learn.synth.records import Row
from lalaloc_core.learn.synth.rendering.cast import Hits, SceneBatch, trace
from lalaloc_core.learn.synth.rendering.shading import Atlas, Outdoors, shade
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.lighting import Mood, relit
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import Decals, Prisms, RenderScene, SceneRecords
from lalaloc_core.learn.synth.scene.shots import Shot

# Small batches stay in a CPU's caches, large ones fill a GPU.
_BATCH_PIXELS = {"cpu": 1 << 17}
_BATCH_PIXELS_ELSEWHERE = 1 << 21
# Padding of tables: walls of no room, decals on no wall, and a small box far away.
_NO_ROOM = -(10**6)
_PADDING = {"decals": Decals.row(wall=-1.0), "prisms": Prisms.row(x_m=1e6, axis_x=1.0, half_a_m=1.0, half_b_m=1.0)}


@dataclasses.dataclass(frozen=True)
class Window:
    """Part of the sphere around a shot's heading: the azimuths it spans and its upper border, radians.

    Pixels are as high as they are wide.
    """

    width: float
    top: float


class SphereRenderer:
    """Renders shots as equirectangular spheres of one size on one device.

    `supersample` is the number of rays per pixel along a column and along a row, or one number for both. Photographs
    average over their pixels; (2, 1) smooths the edges of floor and ceiling, 2 those of doors too. `window` is the part
    of the sphere to render, None for all of it; it shows no traces of stitching, and nothing that covers the poles.
    """

    def __init__(
        self,
        materials: MaterialLibrary,
        *,
        height: int = 128,
        width: int = 256,
        device: str | torch.device = "cpu",
        supersample: int | tuple[int, int] = 1,
        window: Window | None = None,
    ) -> None:
        if window is None and height % 2:
            raise InvalidInputError(f"a sphere of {height} rows has a row on the horizon; the height must be even")
        self._materials = materials
        self._device = torch.device(device)
        self._atlas = Atlas(materials, self._device)
        self._outdoors = Outdoors(self._device)
        rays = (supersample, supersample) if isinstance(supersample, int) else supersample
        if min(rays) < 1:
            raise InvalidInputError(f"{rays} rays per pixel along its two axes, at least 1 is needed along each")
        self._rays_per_pixel = rays
        rows, columns = height * rays[0], width * rays[1]
        pixels = _BATCH_PIXELS.get(self._device.type, _BATCH_PIXELS_ELSEWHERE)
        self._batch_size = max(1, pixels // (rows * columns))
        self._window = window
        elevations, azimuths = row_elevations(rows), column_azimuths(columns)
        if window is not None:
            elevations = window.top - (np.arange(rows) + 0.5) * (window.width / width / rays[0])
            azimuths = azimuths * (window.width / TWO_PI)
        self._slope = self._tensor(np.tan(elevations))
        self._azimuth = self._tensor(azimuths)
        # Pictures use differently rolled parts of one noise field, because new noise would cost more than the rays.
        self._noise = self._tensor(np.random.default_rng(0).normal(size=(height + 64, width + 64, 3)))

    def render(self, shots: Sequence[Shot]) -> UInt8[Tensor, "b h w 3"]:
        """Photograph `shots`; each picture depends on its shot and the materials only."""
        return self.render_scenes([build_scene(shot, self._materials) for shot in shots])

    @torch.no_grad()
    def render_scenes(self, scenes: Sequence[RenderScene], *, walls: bool = False) -> UInt8[Tensor, "b h w c"]:
        """Photograph scenes that were built elsewhere with the same materials, such as in worker processes.

        With `walls` a fourth channel is 255 where a wall, or an opening in it, is seen and not furniture before it.
        """
        step = self._batch_size
        return torch.cat([self._render_batch(scenes[k : k + step], walls) for k in range(0, len(scenes), step)])

    def _render_batch(self, scenes: Sequence[RenderScene], walls: bool) -> UInt8[Tensor, "b h w c"]:
        batch, direction, hits = self._trace(scenes)
        picture = self._photograph(batch, hits, direction)
        if not walls:
            return picture
        is_wall = (~hits.furniture & (hits.normal[..., 2] == 0.0)).float().transpose(1, 2)
        seen = torch.nn.functional.avg_pool2d(is_wall[:, None], self._rays_per_pixel)[:, 0] >= 0.5
        return torch.cat([picture, 255 * seen[..., None].to(torch.uint8)], dim=3)

    @torch.no_grad()
    def render_moods(
        self, shot: Shot, moods: Sequence[Mood]
    ) -> tuple[UInt8[Tensor, "m h w 3"], Float[Tensor, "h2 w2"]]:
        """Photograph a staged shot in several lights, casting its rays once; return pictures and ranges (m)."""
        scene = build_scene(dataclasses.replace(shot, lighting="raw"), self._materials)
        _, direction, hits = self._trace([scene])
        pictures = [
            self._photograph(stack_scenes([relit(scene, mood)], self._device), hits, direction) for mood in moods
        ]
        return torch.cat(pictures), self._range_m(hits)[0]

    @torch.no_grad()
    def hits(self, shots: Sequence[Shot]) -> Hits:
        """Return the hit of every ray, laid out (b, w, h): distances, surfaces, normals."""
        return self._trace([build_scene(shot, self._materials) for shot in shots])[2]

    @torch.no_grad()
    def depth_m(self, shots: Sequence[Shot]) -> Float[Tensor, "b h w"]:
        """Return the range (m) along each pixel's ray, furniture included; at least as large as a sphere."""
        return self._range_m(self.hits(shots))

    def _photograph(self, batch: SceneBatch, hits: Hits, direction: Float[Tensor, "b c 2"]) -> UInt8[Tensor, "b h w 3"]:
        radiance = shade(batch, hits, direction, self._slope, self._atlas, self._outdoors).transpose(1, 2)
        if self._rays_per_pixel != (1, 1):
            planes = radiance.clamp(max=8.0).permute(0, 3, 1, 2)
            radiance = torch.nn.functional.avg_pool2d(planes, self._rays_per_pixel).permute(0, 2, 3, 1)
        exposure = batch.exposure if self._window is None else without_stitching(batch.exposure)
        return develop(radiance, exposure, self._noise)

    def _range_m(self, hits: Hits) -> Float[Tensor, "b h w"]:
        return hits.distance_m.transpose(1, 2) * torch.sqrt(1.0 + self._slope.square())[None, :, None]

    def _trace(self, scenes: Sequence[RenderScene]) -> tuple[SceneBatch, Float[Tensor, "b c 2"], Hits]:
        """Return a batch of scenes, the direction of each column, and the hits of all rays."""
        batch = stack_scenes(scenes, self._device)
        azimuth = batch.heading[:, None] + self._azimuth
        direction = torch.stack([azimuth.sin(), azimuth.cos()], dim=-1)
        return batch, direction, trace(batch, direction, self._slope)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float32)).to(self._device)


def stack_scenes(scenes: Sequence[RenderScene], device: torch.device) -> SceneBatch:
    """Pad the tables of scenes to one length and stack them."""

    def stack(rows: Sequence[np.ndarray], dtype: torch.dtype = torch.float32, padding: Row | int = 0) -> Tensor:
        padded = np.zeros((len(rows), max(1, *(len(row) for row in rows)), *rows[0].shape[1:]))
        padded[:] = padding
        for target, row in zip(padded, rows, strict=True):
            target[: len(row)] = row
        return torch.from_numpy(padded).to(device=device, dtype=dtype)

    def stack_records(name: str) -> Any:
        records = [getattr(scene, name) for scene in scenes]
        return type(records[0])(stack([record.rows for record in records], padding=_PADDING.get(name, 0)))

    return SceneBatch(
        camera_height_m=torch.tensor([scene.camera_height_m for scene in scenes], dtype=torch.float32, device=device),
        heading=torch.tensor([scene.heading for scene in scenes], dtype=torch.float32, device=device),
        walls_m=stack([scene.walls_m for scene in scenes]),
        wall_owner=stack([scene.wall_owner for scene in scenes], torch.long, _NO_ROOM),
        wall_surface=stack([scene.wall_surface for scene in scenes], torch.long),
        **{field.name: stack_records(field.name) for field in dataclasses.fields(SceneRecords)},
    )
