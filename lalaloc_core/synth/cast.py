"""Casting the rays of panoramas against batches of scenes, column by column.

All tensors are laid out (b, c, h): batch, azimuth column, image row. A column's rays lie in one vertical plane, so
walls and prisms are intersected once per column in 2-D, and a row only compares heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lalaloc_core.synth import render_scene as S
from lalaloc_core.synth.prisms import PrismHits, cross_prisms, gap_behind, resolve_prisms

_CORNER_TOLERANCE = 1e-5
_TINY = 1e-9
_MAX_DECALS_PER_COLUMN = 10


@dataclass(frozen=True, eq=False)
class SceneBatch:
    """Scenes padded to one size and stacked; see `RenderScene` for the fields."""

    camera_height_m: Float[Tensor, "b"]
    heading: Float[Tensor, "b"]
    walls_m: Float[Tensor, "b n 4"]
    wall_owner: Int[Tensor, "b n"]
    wall_surface: Int[Tensor, "b n"]
    decals: Float[Tensor, "b d 8"]
    prisms: Float[Tensor, "b p 11"]
    surfaces: Float[Tensor, "b s 12"]
    slots: Float[Tensor, "b r 12"]
    lights: Float[Tensor, "b l 8"]
    sun: Float[Tensor, "b 14"]
    backdrop: Float[Tensor, "b 10"]
    exposure: Float[Tensor, "b 24"]


@dataclass(frozen=True, eq=False)
class Hits:
    """What each pixel sees.

    Attributes:
        distance_m: horizontal distance to it.
        surface: row of the scene's surfaces.
        slot: room it lies in (0 for all furniture seen through the own room).
        normal: unit normal, facing the camera.
        furniture: whether it is a prism.
        gap_m: distance in the column's plane to the next piece of furniture behind
            the hit that stands on the floor, inf if there is none; for contact shadows.
        wall_gap_m: on floors and ceilings, distance to the wall that the column ends at; large elsewhere.
        column_end_m: distance of the wall that each column ends at.
    """

    distance_m: Float[Tensor, "b c h"]
    surface: Int[Tensor, "b c h"]
    slot: Int[Tensor, "b c h"]
    normal: Float[Tensor, "b c h 3"]
    furniture: Bool[Tensor, "b c h"]
    gap_m: Float[Tensor, "b c h"]
    wall_gap_m: Float[Tensor, "b c h"]
    column_end_m: Float[Tensor, "b c"]


@dataclass(frozen=True, eq=False)
class _WallHits:
    """Per column: distance, wall index, metres along the wall, surface and unit normal."""

    distance_m: Tensor
    wall: Tensor
    along_m: Tensor
    surface: Tensor
    normal: Tensor


def trace(batch: SceneBatch, direction: Float[Tensor, "b c 2"], slope: Float[Tensor, "h"]) -> Hits:
    """Cast the camera's rays.

    Args:
        batch: the scenes.
        direction: horizontal unit vector of each column.
        slope: tangent of each row's elevation.
    """
    eye = batch.camera_height_m
    t, s, leaving = _cross_walls(batch.walls_m, direction)
    own = _nearest(batch, t, s, direction, (batch.wall_owner == 0)[:, None])
    up = slope > 0.0
    ceiling = batch.slots[:, 0, S.SLOT_CEILING]
    plane = torch.where(up, (ceiling - eye)[:, None], eye[:, None]) / slope.abs()
    distance = torch.minimum(own.distance_m[:, :, None], plane[:, None])
    is_wall = own.distance_m[:, :, None] <= plane[:, None]
    z = slope * distance + eye[:, None, None]
    horizontal = torch.where(
        up, batch.slots[:, 0, S.SLOT_CEILING_SURFACE, None], batch.slots[:, 0, S.SLOT_FLOOR_SURFACE, None]
    ).long()
    surface = torch.where(is_wall, own.surface[:, :, None], horizontal[:, None])
    vertical = torch.where(is_wall, 0.0, torch.where(up, -1.0, 1.0))
    decal = _decals_at(batch, own.wall, own.along_m)
    surface, hole = _paint(batch, decal, z, is_wall, surface)
    slot = torch.zeros_like(surface)
    code = torch.zeros_like(surface)
    limit, behind = own.distance_m, own.normal
    item, column = (hole >= 0).any(dim=2).nonzero(as_tuple=True)
    columns = (item, column)
    if len(item):
        beyond = _look_through(batch, columns, t, s, leaving, direction, slope, own, hole[columns])
        through = beyond.hole
        for whole, part in (
            (distance, beyond.distance_m),
            (surface, beyond.surface),
            (vertical, beyond.vertical),
            (slot, beyond.slot),
            (code, beyond.code),
        ):
            whole[columns] = torch.where(through, part.to(whole.dtype), whole[columns])
        limit, behind = limit.clone(), behind.clone()
        limit[columns] = torch.maximum(limit[columns], beyond.wall_m)
        behind[columns] = beyond.normal
    prisms = cross_prisms(batch.prisms, direction, limit)
    return _merge(batch, distance, surface, slot, code, vertical, own, behind, prisms, direction, limit, slope)


def cast_own_walls(
    walls_m: Float[Tensor, "b n 4"], owner: Int[Tensor, "b n"], direction: Float[Tensor, "b c 2"]
) -> Float[Tensor, "b c"]:
    """Horizontal distance to the walls of the camera's own room."""
    t, _, _ = _cross_walls(walls_m, direction)
    return torch.where((owner == 0)[:, None], t, torch.inf).min(dim=2).values


def _merge(
    batch: SceneBatch,
    distance: Tensor,
    surface: Tensor,
    slot: Tensor,
    code: Tensor,
    vertical: Tensor,
    own: _WallHits,
    behind_normal: Tensor,
    prisms: PrismHits,
    direction: Tensor,
    limit: Tensor,
    slope: Tensor,
) -> Hits:
    """Put the prisms before what was hit so far."""
    hit_m, nearest = resolve_prisms(prisms, distance, slope, batch.camera_height_m)
    furniture = nearest >= 0
    code = torch.where(furniture, nearest + 2, code)
    normals = torch.cat([own.normal[:, :, None], behind_normal[:, :, None], prisms.normal], dim=2)
    place = nearest.clamp(min=0)
    index = prisms.index.gather(2, place)
    rows = batch.prisms[:, :, S.PRISM_SURFACE].long()
    prism_surface = rows[:, None].expand(-1, index.shape[1], -1).gather(2, index)
    surface = torch.where(furniture, prism_surface, surface)
    up = torch.where(slope > 0.0, -1.0, 1.0)
    is_side = prisms.enter_m.gather(2, place) >= hit_m
    vertical = torch.where(furniture, torch.where(is_side, 0.0, up), vertical)
    flat = (vertical != 0.0).float()
    normal = torch.stack(
        [
            normals[..., 0].gather(2, code) * (1.0 - flat),
            normals[..., 1].gather(2, code) * (1.0 - flat),
            vertical,
        ],
        dim=-1,
    )
    # Furniture in the own room before a hole; beyond the hole it shares the slot of what lies behind it.
    slot = torch.where(furniture & (hit_m < own.distance_m[:, :, None]), 0, slot)
    incidence = (own.normal * direction).sum(dim=-1).abs()[:, :, None]
    wall_gap = torch.where(vertical == 0.0, 10.0, ((own.distance_m[:, :, None] - hit_m).abs() * incidence))
    return Hits(hit_m, surface, slot, normal, furniture, gap_behind(prisms, distance), wall_gap, limit)


def _cross_walls(walls_m: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Per column and wall: distance (inf: missed), metres along the wall, and whether the ray leaves the room there."""
    dx, dy = direction[:, :, None, 0], direction[:, :, None, 1]
    x, y = walls_m[:, None, :, 0], walls_m[:, None, :, 1]
    ex, ey = walls_m[:, None, :, 2] - x, walls_m[:, None, :, 3] - y
    determinant = dx * ey - dy * ex
    parallel = determinant.abs() < 1e-12
    inverse = 1.0 / torch.where(parallel, 1.0, determinant)
    t = (x * ey - y * ex) * inverse
    s = (x * dy - y * dx) * inverse
    hit = ~parallel & (t > 0.0) & (s >= -_CORNER_TOLERANCE) & (s <= 1.0 + _CORNER_TOLERANCE)
    return torch.where(hit, t, torch.inf), s * torch.sqrt(ex**2 + ey**2), determinant > 0.0


def _nearest(batch: SceneBatch, t: Tensor, s: Tensor, direction: Tensor, candidate: Tensor) -> _WallHits:
    distance, wall = torch.where(candidate, t, torch.inf).min(dim=2)
    along = s.gather(2, wall[:, :, None])[:, :, 0]
    return _WallHits(
        distance, wall, along, batch.wall_surface.gather(1, wall), _facing_normal(batch.walls_m, wall, direction)
    )


def _facing_normal(walls_m: Tensor, wall: Tensor, direction: Tensor) -> Tensor:
    ends = walls_m.gather(1, wall[:, :, None].expand(-1, -1, 4))
    normal = torch.stack([ends[..., 1] - ends[..., 3], ends[..., 2] - ends[..., 0]], dim=-1)
    normal = normal / (normal.norm(dim=-1, keepdim=True) + _TINY)
    toward = (normal * direction).sum(dim=-1, keepdim=True)
    return torch.where(toward > 0.0, -normal, normal)


def _decals_at(batch: SceneBatch, wall: Tensor, along_m: Tensor) -> Int[Tensor, "b c k"]:
    """Indices of the decals that a column's wall hit may meet, in painting order; -1 pads."""
    decals = batch.decals
    on = (
        (decals[:, None, :, S.DECAL_WALL] == wall[:, :, None])
        & (decals[:, None, :, S.DECAL_S0] <= along_m[:, :, None])
        & (decals[:, None, :, S.DECAL_S1] >= along_m[:, :, None])
    )
    order = torch.where(on, torch.arange(decals.shape[1], device=decals.device), -1)
    most = min(int(on.sum(dim=2).max()), _MAX_DECALS_PER_COLUMN)
    return order.topk(most, dim=2).values.flip(2)


def _paint(
    batch: SceneBatch, decal: Tensor, z: Tensor, is_wall: Tensor, surface: Tensor
) -> tuple[Int[Tensor, "b c h"], Int[Tensor, "b c h"]]:
    """Paint decals onto wall pixels; returns the surface and, where the wall has a hole, the decal that makes it."""
    hole = torch.full_like(surface, -1)
    for k in range(decal.shape[2]):
        index = decal[:, :, k]
        rows = batch.decals.gather(1, index.clamp(min=0)[:, :, None].expand(-1, -1, batch.decals.shape[2]))
        rows = torch.where((index >= 0)[:, :, None], rows, torch.tensor(-1.0, device=rows.device))
        inside = is_wall & (z >= rows[:, :, S.DECAL_Z0, None]) & (z <= rows[:, :, S.DECAL_Z1, None])
        surface = torch.where(inside, rows[:, :, S.DECAL_SURFACE, None].long(), surface)
        is_hole = torch.where(rows[:, :, S.DECAL_SLOT] >= 0.0, index, -1)
        hole = torch.where(inside, is_hole[:, :, None], hole)
    return surface, hole


@dataclass(frozen=True, eq=False)
class _Beyond:
    """What the columns with a hole see through it, (m, h) unless said otherwise."""

    hole: Tensor
    distance_m: Tensor
    surface: Tensor
    vertical: Tensor
    slot: Tensor
    code: Tensor
    wall_m: Tensor  # (m,) horizontal distance at which the column ends
    normal: Tensor  # (m, 2)


def _look_through(
    batch: SceneBatch,
    columns: tuple[Tensor, Tensor],
    t: Tensor,
    s: Tensor,
    leaving: Tensor,
    direction: Tensor,
    slope: Tensor,
    own: _WallHits,
    hole: Int[Tensor, "m h"],
) -> _Beyond:
    item, _ = columns
    decal = hole.max(dim=1).values
    row = batch.decals[item, decal]
    slot = row[:, S.DECAL_SLOT].long()
    room = batch.slots[item, slot]
    eye = batch.camera_height_m[item]
    near = own.distance_m[columns]
    incidence = (own.normal[columns] * direction[columns]).sum(dim=-1).abs().clamp(min=1e-3)
    far = near + row[:, S.DECAL_DEPTH] / incidence

    owner = batch.wall_owner[item]
    wall_t = t[columns]
    inner = (owner == slot[:, None]) & leaving[columns] & (wall_t > near[:, None] + 1e-4)
    jamb = (owner == -1 - decal[:, None]) & (wall_t <= far[:, None] + 1e-3)
    distance, wall = torch.where(inner | jamb, wall_t, torch.inf).min(dim=1)
    is_jamb = jamb.gather(1, wall[:, None])[:, 0]
    # A ray that slips between jamb and wall by rounding ends where it left.
    distance = torch.where(distance.isfinite(), distance, far)

    up = slope > 0.0
    head, ceiling = row[:, S.DECAL_Z1] - eye, room[:, S.SLOT_CEILING] - eye
    soffit = torch.where(up, head[:, None] / slope, torch.inf)
    plane = torch.where(up, ceiling[:, None], eye[:, None]) / slope.abs()
    in_soffit = soffit < far[:, None]
    plane = torch.where(in_soffit, soffit, plane)
    hit = torch.minimum(distance[:, None], plane)
    is_wall = distance[:, None] <= plane
    z = slope * hit + eye[:, None]

    surface = batch.wall_surface[item, wall][:, None].expand_as(hit)
    trim = row[:, S.DECAL_SURFACE].long()[:, None]
    flat = torch.where(up, room[:, S.SLOT_CEILING_SURFACE, None], room[:, S.SLOT_FLOOR_SURFACE, None]).long()
    surface = torch.where(is_wall, surface, torch.where(in_soffit, trim, flat))
    sub = SceneBatch(**{name: getattr(batch, name)[item] for name in SceneBatch.__dataclass_fields__})
    along = s[columns].gather(1, wall[:, None])
    painted = _decals_at(sub, wall[:, None], along)
    surface, _ = _paint(sub, painted, z[:, None], is_wall[:, None], surface[:, None])
    return _Beyond(
        hole >= 0,
        hit,
        surface[:, 0],
        torch.where(is_wall, 0.0, torch.where(up, -1.0, 1.0)),
        torch.where(is_jamb[:, None] & is_wall, 0, slot[:, None]).expand_as(hit),
        torch.ones_like(hole),
        distance,
        _facing_normal(sub.walls_m, wall[:, None], direction[columns][:, None])[:, 0],
    )
