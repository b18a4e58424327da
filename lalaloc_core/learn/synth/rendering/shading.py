"""Light and colour of the hits, and the view through windows. Tensors are laid out (b, c, h) as in `cast`."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lalaloc_core.conventions import TWO_PI, column_azimuths, row_elevations
from lalaloc_core.learn.synth.rendering.cast import Hits, SceneBatch, cast_own_walls
from lalaloc_core.learn.synth.rendering.prisms import cross_prisms, resolve_prisms
from lalaloc_core.learn.synth.scene.materials import PICTURE_SIZE, MaterialLibrary, smooth_noise
from lalaloc_core.learn.synth.scene.render_scene import Backdrop, Prisms
from lalaloc_core.learn.synth.scene.surfaces import Surfaces

_SIZE = 256


class Outdoors:
    """A mottled pattern shared by all backdrops; each scene colours it."""

    def __init__(self, device: torch.device) -> None:
        rng = np.random.default_rng(0)
        mottle = sum(
            weight * smooth_noise(_SIZE, rng, scale) for scale, weight in ((0.8, 0.5), (3.0, 0.6), (12.0, 0.7))
        )
        outline = sum(weight * smooth_noise(_SIZE, rng, scale)[0] for scale, weight in ((2.0, 0.3), (8.0, 0.8)))
        self._mottle = torch.tensor(mottle, dtype=torch.float32, device=device)
        self._outline = torch.tensor(outline, dtype=torch.float32, device=device)

    def colour(
        self, backdrop: Backdrop, direction: Float[Tensor, "n 2"], slope: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Return the colour along rays; `backdrop` has one row per ray."""
        azimuth = torch.atan2(direction[:, 0], direction[:, 1]) / TWO_PI
        turn = azimuth + backdrop.turn
        column = (turn.remainder(1.0) * _SIZE).long().clamp(max=_SIZE - 1)
        fine_column = ((4.0 * turn).remainder(1.0) * _SIZE).long().clamp(max=_SIZE - 1)
        row = ((slope.atan() * (4.0 / math.pi) + backdrop.lift).remainder(1.0) * _SIZE).long()
        mottle = self._mottle[row.clamp(max=_SIZE - 1), fine_column]
        horizon = backdrop.horizon + backdrop.ruggedness * self._outline[column]
        sky = ((slope - horizon) / 0.06).clamp(0.0, 1.0)[:, None]
        ground = backdrop.ground * torch.exp(0.5 * mottle)[:, None]
        return sky * backdrop.sky + (1.0 - sky) * ground.clamp(max=1.0)


_SHADOW_COLUMNS, _SHADOW_ROWS = 80, 40
_LEVELS = int(math.log2(PICTURE_SIZE)) + 1
# Light sources are not points: distances below this do not make things brighter.
_SOURCE_SIZE_M2 = 0.4


class Atlas:
    """All pictures of materials in all mip levels, as one flat list of packed pixels."""

    def __init__(self, materials: MaterialLibrary, device: torch.device) -> None:
        level = materials.pictures.permute(0, 3, 1, 2)
        texels, self._offsets, offset = [], [], 0
        for _ in range(_LEVELS):
            # Stored with a square-root curve: 8 bits of linear light would band in dark materials.
            packed = (level.clamp(0.0, 1.0).sqrt() * 255.0).round().to(torch.uint8).permute(0, 2, 3, 1)
            padded = torch.nn.functional.pad(packed.reshape(-1, 3), (0, 1)).contiguous()
            texels.append(padded.view(torch.int32)[:, 0])
            self._offsets.append(offset)
            offset += len(texels[-1])
            level = torch.nn.functional.avg_pool2d(level, 2) if level.shape[-1] > 1 else level
        self._texels = torch.cat(texels).to(device)
        self._offset_table = torch.tensor(self._offsets, device=device)

    def sample(self, picture: Int[Tensor, "*n"], u: Tensor, v: Tensor, texels_per_pixel: Tensor) -> Tensor:
        """Return linear colour (n..., 3) at picture coordinates (u, v), averaged over about `texels_per_pixel`."""
        level = texels_per_pixel.clamp(min=1.0).log2().round().clamp(max=_LEVELS - 1).int()
        size = PICTURE_SIZE >> level
        x = ((u - u.floor()) * size).int().clamp(max=PICTURE_SIZE - 1)
        y = ((v - v.floor()) * size).int().clamp(max=PICTURE_SIZE - 1)
        x, y = torch.minimum(x, size - 1), torch.minimum(y, size - 1)
        index = self._offset_table[level.long()] + ((picture * size + y) * size + x).long()
        packed = self._texels[index.reshape(-1)]
        colour = packed.view(torch.uint8).reshape(-1, 4)[:, :3].float() * (1.0 / 255.0)
        return (colour * colour).reshape(*picture.shape, 3)


def shade(
    batch: SceneBatch,
    hits: Hits,
    direction: Float[Tensor, "b c 2"],
    slope: Float[Tensor, "h"],
    atlas: Atlas,
    outdoors: Outdoors,
) -> Float[Tensor, "b c h 3"]:
    """Return the linear radiance of every pixel."""
    d = hits.distance_m
    x, y = direction[:, :, None, 0] * d, direction[:, :, None, 1] * d
    z = slope * d + batch.camera_height_m[:, None, None]
    point = (x, y, z)
    surface = _surface_of(batch.surfaces, hits.surface)
    albedo = _albedo(surface, hits, point, slope, atlas)
    light = _direct_light(batch, hits, point)
    light += _ambient(batch, hits, point)
    _add_sunlight(batch, hits, point, light)
    glow = surface.glow[..., None]
    radiance = albedo.mul_(torch.where(glow > 0.0, glow, light))
    item, column, row = (surface.is_outdoors > 0.5).nonzero(as_tuple=True)
    seen = outdoors.colour(batch.backdrop[item], direction[item, column], slope[row])
    radiance[item, column, row] = seen * glow[item, column, row]
    return _add_reflections(batch, hits, radiance, surface.gloss, slope)


def _surface_of(surfaces: Surfaces, index: Int[Tensor, "b c h"]) -> Surfaces:
    batch, size, width = surfaces.rows.shape
    flat = index + (torch.arange(batch, device=index.device) * size)[:, None, None]
    return Surfaces(surfaces.rows.reshape(-1, width)[flat.reshape(-1)].reshape(*index.shape, width))


def _albedo(
    surface: Surfaces, hits: Hits, point: tuple[Tensor, Tensor, Tensor], slope: Tensor, atlas: Atlas
) -> Float[Tensor, "b c h 3"]:
    x, y, z = point
    nx, ny, nz = hits.normal.unbind(-1)
    flat = nz != 0.0
    u = torch.where(flat, x, y * nx - x * ny)
    v = torch.where(flat, y, -z)
    scale, cosine, sine = surface.scale, surface.cosine, surface.sine
    u, v = (scale * (cosine * u - sine * v) + surface.shift_u, scale * (sine * u + cosine * v) + surface.shift_v)
    distance = hits.distance_m * torch.sqrt(1.0 + slope**2)
    # The footprint of a pixel grows with distance and at grazing angles.
    grazing = torch.where(flat, (slope.abs() / torch.sqrt(1.0 + slope**2)), 1.0).clamp(min=0.1)
    # Use the mean ray density of both axes.
    pitch = math.pi * math.sqrt(2.0 / (slope.shape[0] * hits.distance_m.shape[1]))
    footprint = distance * scale * (PICTURE_SIZE * pitch) / torch.sqrt(grazing)
    colour = atlas.sample(surface.picture.int(), u, v, footprint)
    return (colour * surface.tint).clamp(max=0.95)


def _direct_light(batch: SceneBatch, hits: Hits, point: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "b c h 3"]:
    nx, ny, nz = hits.normal.unbind(-1)
    maps = _shadow_maps(batch)
    received = []
    for k in range(batch.lights.rows.shape[1]):
        light = batch.lights[:, k, None, None]
        to = [light.position_m[..., axis] - point[axis] for axis in range(3)]
        square = to[0] ** 2 + to[1] ** 2 + to[2] ** 2
        distance = torch.sqrt(square)
        lambert = (to[0] * nx + to[1] * ny + to[2] * nz).clamp(min=0.0)
        # A window shines forwards: the more obliquely, the less. A lamp (normal 0) shines everywhere.
        ahead_x, ahead_y = light.normal.unbind(-1)
        is_lamp = ((ahead_x == 0.0) & (ahead_y == 0.0)).float()
        forwards = (-(to[0] * ahead_x + to[1] * ahead_y)).clamp(min=0.0) / distance + is_lamp
        spread = distance * (square + _SOURCE_SIZE_M2)
        received.append(_visibility(maps[:, k], to, distance) * lambert * forwards / spread)
    colour = batch.lights.colour
    light = torch.bmm(torch.stack(received, dim=-1).flatten(1, 2), colour).reshape(hits.normal.shape)
    return _light_beyond(batch, hits, point, light)


def _light_beyond(
    batch: SceneBatch, hits: Hits, point: tuple[Tensor, Tensor, Tensor], light: Float[Tensor, "b c h 3"]
) -> Float[Tensor, "b c h 3"]:
    """Replace the light of rooms seen through doors by that of their own single lamp, without shadows."""
    beyond = hits.slot.nonzero(as_tuple=True)
    room = batch.rooms[beyond[0], hits.slot[beyond]]
    to = room.light_m - torch.stack([axis[beyond] for axis in point], dim=-1)
    square = (to**2).sum(dim=-1)
    lambert = ((to * hits.normal[beyond]).sum(dim=-1) / torch.sqrt(square + 1e-6)).clamp(min=0.0)
    light[beyond] = (lambert / (square + _SOURCE_SIZE_M2))[:, None] * room.light_colour
    return light


def _shadow_maps(batch: SceneBatch) -> Float[Tensor, "b l 2 rows columns"]:
    """Return mean and mean square of the distance of light from each lamp (variance shadow maps)."""
    count, lights = batch.lights.rows.shape[:2]
    device = batch.lights.rows.device
    azimuth = torch.tensor(column_azimuths(_SHADOW_COLUMNS), dtype=torch.float32, device=device)
    elevation = torch.tensor(row_elevations(_SHADOW_ROWS), dtype=torch.float32, device=device)
    slope = elevation.tan()
    direction = torch.stack([azimuth.sin(), azimuth.cos()], dim=-1).expand(count * lights, -1, -1)
    position = batch.lights.xy_m.reshape(-1, 2)
    walls = batch.walls_m.repeat_interleave(lights, 0) - position.repeat(1, 2)[:, None]
    owner = batch.wall_owner.repeat_interleave(lights, 0)
    prisms = Prisms(batch.prisms.rows.repeat_interleave(lights, 0).clone())
    prisms.centre_m -= position[:, None]
    # Move prisms without shadows out of the way.
    prisms.x_m += torch.where(prisms.is_opaque > 0.5, 0.0, 1e6)
    wall_m = cast_own_walls(walls, owner, direction)
    height = batch.lights.z_m.reshape(-1)
    limit = torch.minimum(wall_m[:, :, None], (height[:, None] / slope.abs())[:, None])
    distance, _ = resolve_prisms(cross_prisms(prisms, direction, wall_m), limit, slope, height)
    travel = (distance * torch.sqrt(1.0 + slope**2)).clamp(max=30.0)
    moments = torch.stack([travel, travel**2], dim=1).transpose(2, 3)
    moments = torch.nn.functional.pad(moments, (1, 1, 0, 0), mode="circular")
    blurred = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(moments, (0, 0, 1, 1), mode="replicate"), 3, stride=1
    )
    # One column more on either side lets a lookup cross the seam.
    blurred = torch.nn.functional.pad(blurred, (1, 1, 0, 0), mode="circular")
    return blurred.reshape(count, lights, 2, _SHADOW_ROWS, _SHADOW_COLUMNS + 2)


def _visibility(
    moments: Float[Tensor, "b 2 rows columns"], to_light: list[Tensor], distance: Tensor
) -> Float[Tensor, "b c h"]:
    """Return the visible share of a lamp from a point (Chebyshev's bound on the shadow map)."""
    azimuth = torch.atan2(-to_light[0], -to_light[1])
    elevation = torch.asin((-to_light[2] / distance).clamp(-1.0, 1.0))
    width = _SHADOW_COLUMNS + 2
    column = (azimuth / TWO_PI + 0.5) * _SHADOW_COLUMNS + 1.0
    grid = torch.stack([column * (2.0 / width) - 1.0, -elevation * (2.0 / math.pi)], dim=-1)
    looked = torch.nn.functional.grid_sample(moments, grid, align_corners=False, padding_mode="border")
    mean, square = looked[:, 0], looked[:, 1]
    variance = (square - mean**2).clamp(min=4e-3)
    beyond = distance - mean - 0.06
    bound = variance / (variance + beyond.clamp(min=0.0) ** 2)
    # Cutting the tail of the bound hides light that leaks through where two shadows overlap.
    return torch.where(beyond <= 0.0, 1.0, ((bound - 0.25) / 0.75).clamp(min=0.0))


def _add_sunlight(
    batch: SceneBatch, hits: Hits, point: tuple[Tensor, Tensor, Tensor], light: Float[Tensor, "b c h 3"]
) -> None:
    sun = batch.sun[:, None, None]
    (start_x, start_y), (ax, ay) = sun.wall_start_m.unbind(-1), sun.wall_along.unbind(-1)
    toward_x, toward_y, rise = sun.direction.unbind(-1)
    from_x, from_y = start_x - point[0], start_y - point[1]
    speed = toward_x * ay - toward_y * ax
    travel = (from_x * ay - from_y * ax) / torch.where(speed.abs() < 1e-6, 1e-6, speed)
    along = (travel * toward_x - from_x) * ax + (travel * toward_y - from_y) * ay
    z = point[2] + travel * rise
    falls = (along > sun.s0_m) & (along < sun.s1_m) & (z > sun.z0_m) & (z < sun.z1_m) & (travel > 0.0)
    lit = (falls & (hits.slot == 0)).nonzero(as_tuple=True)
    shining = batch.sun[lit[0]]
    lambert = (hits.normal[lit] * shining.direction).sum(dim=-1, keepdim=True).clamp(min=0.0)
    light[lit] += lambert * shining.colour


def _ambient(batch: SceneBatch, hits: Hits, point: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "b c h 3"]:
    beyond = hits.slot.nonzero(as_tuple=True)
    room = batch.rooms[beyond[0], hits.slot[beyond]]
    z, nz = point[2], hits.normal[..., 2]
    own = batch.rooms[:, 0, None, None]
    ceiling = own.ceiling_m.expand_as(z).clone()
    ceiling[beyond] = room.ceiling_m
    ambient = own.ambient.expand_as(hits.normal).clone()
    ambient[beyond] = room.ambient
    upright = nz == 0.0
    floor_gap, ceiling_gap = z.clamp(min=0.0), (ceiling - z).clamp(min=0.0)
    edge = torch.where(upright, torch.minimum(floor_gap, ceiling_gap), 10.0)
    edge = torch.minimum(edge, torch.where(hits.furniture, 10.0, hits.wall_gap_m))
    occlusion = 1.0 - 0.35 * torch.exp(-edge / 0.18)
    on_floor = (nz > 0.0) & ~hits.furniture
    occlusion = occlusion * torch.where(on_floor, 1.0 - 0.5 * torch.exp(-hits.gap_m / 0.12), 1.0)
    # Undersides see the floor only; the lower half of a room gets a little less.
    facing = torch.where(upright, 0.85, torch.where(nz > 0.0, 1.0, 0.75))
    facing = torch.where(hits.furniture & (nz < 0.0), 0.35, facing)
    return ambient.mul_((occlusion * facing)[..., None])


def _add_reflections(
    batch: SceneBatch, hits: Hits, radiance: Tensor, gloss: Tensor, slope: Tensor
) -> Float[Tensor, "b c h 3"]:
    """Add reflections of the same column in glossy floors."""
    is_floor = (gloss > 0.0) & (hits.normal[..., 2] > 0.0) & ~hits.furniture & (hits.slot == 0)
    item, column, row = is_floor.nonzero(as_tuple=True)
    rows = slope.shape[0]
    wall_m, slope = hits.column_end_m[item, column], slope[row]
    # The mirrored ray climbs from the floor and meets the column's wall at this height.
    climbed = -slope * (wall_m - hits.distance_m[item, column, row])
    seen = torch.atan2(climbed - batch.camera_height_m[item], wall_m)
    mirrored_row = ((0.5 - seen / math.pi) * rows).long().clamp(0, rows - 1)
    mirrored = radiance[item, column, mirrored_row].clamp(max=8.0)
    sine = slope.abs() / torch.sqrt(1.0 + slope**2)
    fresnel = 0.25 + 0.75 * (1.0 - sine) ** 3
    share = (gloss[item, column, row] * fresnel)[:, None]
    radiance[item, column, row] = (1.0 - share) * radiance[item, column, row] + share * mirrored
    return radiance
