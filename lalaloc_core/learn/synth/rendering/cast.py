"""Ray casting of spheres against batches of scenes, column by column.

All tensors are laid out (b, c, h): batch, azimuth column, image row. The rays of a column lie in one vertical plane, so
walls and prisms are intersected once per column in 2-D, and a row only compares heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lalaloc_core.learn.synth.rendering.prisms import PrismHits, cross_prisms, gap_behind, resolve_prisms
from lalaloc_core.learn.synth.scene.render_scene import Decals, SceneRecords
from lalaloc_core.render.profile import CORNER_TOLERANCE

_TINY = 1e-9
_PARALLEL = 1e-12
_MAX_DECALS_PER_COLUMN = 10


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneBatch(SceneRecords):
    """Scenes padded to one size and stacked; see `RenderScene` for the fields, records of rows (b, n)."""

    camera_height_m: Float[Tensor, "b"]
    heading: Float[Tensor, "b"]
    walls_m: Float[Tensor, "b n 4"]
    wall_owner: Int[Tensor, "b n"]
    wall_surface: Int[Tensor, "b n"]

    def __getitem__(self, index: Tensor) -> SceneBatch:
        return SceneBatch(**{name: getattr(self, name)[index] for name in SceneBatch.__dataclass_fields__})


@dataclass(frozen=True, eq=False)
class Hits:
    """Visible surface of each pixel.

    Attributes:
        distance_m: horizontal distance.
        surface: row of the scene's surfaces.
        slot: its room (0 for all furniture seen through the own room).
        normal: unit normal, facing the camera.
        gap_m: distance in the column's plane to the next piece of furniture behind the hit that stands on the floor,
            inf if there is none; for contact shadows.
        wall_gap_m: on floors and ceilings, distance to the wall at the end of the column; large elsewhere.
        column_end_m: distance of the wall at the end of each column.
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
class _Crossings:
    """Per column and wall: distance (inf for a miss), metres along the wall, and if the ray leaves the room there."""

    distance_m: Float[Tensor, "b c n"]
    along_m: Float[Tensor, "b c n"]
    leaving: Bool[Tensor, "b c n"]


@dataclass(frozen=True, eq=False)
class _WallHits:
    """Per column: distance, wall index, metres along the wall, surface and unit normal."""

    distance_m: Float[Tensor, "b c"]
    wall: Int[Tensor, "b c"]
    along_m: Float[Tensor, "b c"]
    surface: Int[Tensor, "b c"]
    normal: Float[Tensor, "b c 2"]


@dataclass(frozen=True, eq=False)
class _ShellHits:
    """Hits on walls, floors and ceilings, before furniture; (b, c, h) unless noted.

    Attributes:
        vertical: z of the normal, 0 on walls.
        is_beyond: 1 for pixels seen through a hole, whose walls have the normals `beyond_normal`; else 0.
        own: walls of the own room.
        beyond_normal: (b, c, 2) normals of the walls at the end of columns with a hole.
        end_m: (b, c) horizontal distance at the end of each column.
    """

    distance_m: Tensor
    surface: Tensor
    slot: Tensor
    vertical: Tensor
    is_beyond: Tensor
    own: _WallHits
    beyond_normal: Tensor
    end_m: Tensor


def trace(batch: SceneBatch, direction: Float[Tensor, "b c 2"], slope: Float[Tensor, "h"]) -> Hits:
    """Cast the camera's rays: a horizontal unit vector per column, and the tangent of the elevation per row."""
    shell = _trace_shell(batch, direction, slope)
    return _before(batch, shell, cross_prisms(batch.prisms, direction, shell.end_m), direction, slope)


def cast_own_walls(
    walls_m: Float[Tensor, "b n 4"], owner: Int[Tensor, "b n"], direction: Float[Tensor, "b c 2"]
) -> Float[Tensor, "b c"]:
    """Return the horizontal distance to the walls of the camera's own room."""
    distance = _cross_walls(walls_m, direction).distance_m
    return torch.where((owner == 0)[:, None], distance, torch.inf).min(dim=2).values


def _trace_shell(batch: SceneBatch, direction: Float[Tensor, "b c 2"], slope: Float[Tensor, "h"]) -> _ShellHits:
    eye, room = batch.camera_height_m, batch.rooms[:, 0]
    crossings = _cross_walls(batch.walls_m, direction)
    own = _nearest(batch, crossings, direction, (batch.wall_owner == 0)[:, None])
    up = slope > 0.0
    plane = torch.where(up, (room.ceiling_m - eye)[:, None], eye[:, None]) / slope.abs()
    distance = torch.minimum(own.distance_m[:, :, None], plane[:, None])
    is_wall = own.distance_m[:, :, None] <= plane[:, None]
    z = slope * distance + eye[:, None, None]
    horizontal = torch.where(up, room.ceiling_surface[:, None], room.floor_surface[:, None]).long()
    surface = torch.where(is_wall, own.surface[:, :, None], horizontal[:, None])
    vertical = torch.where(is_wall, 0.0, torch.where(up, -1.0, 1.0))
    surface, hole = _paint(batch, _decals_at(batch, own.wall, own.along_m), z, is_wall, surface)
    shell = _ShellHits(
        distance_m=distance,
        surface=surface,
        slot=torch.zeros_like(surface),
        vertical=vertical,
        is_beyond=torch.zeros_like(surface),
        own=own,
        beyond_normal=own.normal.clone(),
        end_m=own.distance_m.clone(),
    )
    item, column = (hole >= 0).any(dim=2).nonzero(as_tuple=True)
    if len(item):
        _look_through(batch, shell, (item, column), crossings, direction, slope, hole[item, column])
    return shell


def _before(
    batch: SceneBatch, shell: _ShellHits, prisms: PrismHits, direction: Float[Tensor, "b c 2"], slope: Tensor
) -> Hits:
    """Return the hits with prisms in front of the shell."""
    own_m, own_normal = shell.own.distance_m[:, :, None], shell.own.normal
    hit_m, nearest = resolve_prisms(prisms, shell.distance_m, slope, batch.camera_height_m)
    furniture = nearest >= 0
    # Normals to choose from: of the own walls, of those beyond a hole, of the prisms.
    normals = torch.cat([own_normal[:, :, None], shell.beyond_normal[:, :, None], prisms.normal], dim=2)
    chosen = torch.where(furniture, nearest + 2, shell.is_beyond)
    place = nearest.clamp(min=0)
    index = prisms.index.gather(2, place)
    prism_surface = batch.prisms.surface.long()[:, None].expand(-1, index.shape[1], -1).gather(2, index)
    surface = torch.where(furniture, prism_surface, shell.surface)
    up = torch.where(slope > 0.0, -1.0, 1.0)
    is_side = prisms.enter_m.gather(2, place) >= hit_m
    vertical = torch.where(furniture, torch.where(is_side, 0.0, up), shell.vertical)
    flat = (vertical != 0.0).float()
    normal = torch.stack(
        [normals[..., 0].gather(2, chosen) * (1.0 - flat), normals[..., 1].gather(2, chosen) * (1.0 - flat), vertical],
        dim=-1,
    )
    # Furniture in the own room before a hole; beyond the hole it shares the slot of the surface behind it.
    slot = torch.where(furniture & (hit_m < own_m), 0, shell.slot)
    incidence = (own_normal * direction).sum(dim=-1).abs()[:, :, None]
    wall_gap = torch.where(vertical == 0.0, 10.0, (own_m - hit_m).abs() * incidence)
    return Hits(
        distance_m=hit_m,
        surface=surface,
        slot=slot,
        normal=normal,
        furniture=furniture,
        gap_m=gap_behind(prisms, shell.distance_m),
        wall_gap_m=wall_gap,
        column_end_m=shell.end_m,
    )


def _cross_walls(walls_m: Float[Tensor, "b n 4"], direction: Float[Tensor, "b c 2"]) -> _Crossings:
    """Solve t * direction = start + share * edge by Cramer's rule; rooms lie to the left of their walls."""
    x, y = walls_m[:, None, :, 0], walls_m[:, None, :, 1]
    ex, ey = walls_m[:, None, :, 2] - x, walls_m[:, None, :, 3] - y
    dx, dy = direction[:, :, None, 0], direction[:, :, None, 1]
    determinant = dx * ey - dy * ex
    parallel = determinant.abs() < _PARALLEL
    inverse = 1.0 / torch.where(parallel, 1.0, determinant)
    t = (x * ey - y * ex) * inverse
    share = (x * dy - y * dx) * inverse
    hit = ~parallel & (t > 0.0) & (share >= -CORNER_TOLERANCE) & (share <= 1.0 + CORNER_TOLERANCE)
    return _Crossings(
        distance_m=torch.where(hit, t, torch.inf), along_m=share * torch.sqrt(ex**2 + ey**2), leaving=determinant > 0.0
    )


def _nearest(batch: SceneBatch, crossings: _Crossings, direction: Tensor, candidate: Tensor) -> _WallHits:
    distance, wall = torch.where(candidate, crossings.distance_m, torch.inf).min(dim=2)
    return _WallHits(
        distance_m=distance,
        wall=wall,
        along_m=crossings.along_m.gather(2, wall[:, :, None])[:, :, 0],
        surface=batch.wall_surface.gather(1, wall),
        normal=_facing_normal(batch.walls_m, wall, direction),
    )


def _facing_normal(walls_m: Tensor, wall: Tensor, direction: Tensor) -> Tensor:
    ends = walls_m.gather(1, wall[:, :, None].expand(-1, -1, 4))
    normal = torch.stack([ends[..., 1] - ends[..., 3], ends[..., 2] - ends[..., 0]], dim=-1)
    normal = normal / (normal.norm(dim=-1, keepdim=True) + _TINY)
    toward = (normal * direction).sum(dim=-1, keepdim=True)
    return torch.where(toward > 0.0, -normal, normal)


def _decals_at(batch: SceneBatch, wall: Tensor, along_m: Tensor) -> Int[Tensor, "b c k"]:
    """Return the indices of decals that a column's wall hit may meet, in painting order; -1 pads."""
    decals = batch.decals[:, None]
    on = (decals.wall == wall[:, :, None]) & (decals.s0_m <= along_m[:, :, None]) & (decals.s1_m >= along_m[:, :, None])
    order = torch.where(on, torch.arange(on.shape[2], device=on.device), -1)
    most = min(int(on.sum(dim=2).max()), _MAX_DECALS_PER_COLUMN)
    return order.topk(most, dim=2).values.flip(2)


def _paint(
    batch: SceneBatch, decal: Tensor, z: Tensor, is_wall: Tensor, surface: Tensor
) -> tuple[Int[Tensor, "b c h"], Int[Tensor, "b c h"]]:
    """Paint decals onto wall pixels; return the surface and, where the wall has a hole, its decal."""
    hole = torch.full_like(surface, -1)
    for k in range(decal.shape[2]):
        index = decal[:, :, k]
        rows = batch.decals.rows.gather(1, index.clamp(min=0)[:, :, None].expand(-1, -1, Decals.WIDTH))
        met = Decals(torch.where((index >= 0)[:, :, None], rows, torch.tensor(-1.0, device=rows.device)))
        inside = is_wall & (z >= met.z0_m[:, :, None]) & (z <= met.z1_m[:, :, None])
        surface = torch.where(inside, met.surface[:, :, None].long(), surface)
        is_hole = torch.where(met.slot >= 0.0, index, -1)
        hole = torch.where(inside, is_hole[:, :, None], hole)
    return surface, hole


def _look_through(
    batch: SceneBatch,
    shell: _ShellHits,
    columns: tuple[Tensor, Tensor],
    crossings: _Crossings,
    direction: Tensor,
    slope: Tensor,
    hole: Int[Tensor, "m h"],
) -> None:
    """Replace the hits of m columns by those seen through their holes, in place."""
    item, _ = columns
    decal = hole.max(dim=1).values
    opening = batch.decals[item, decal]
    slot = opening.slot.long()
    room = batch.rooms[item, slot]
    eye = batch.camera_height_m[item]
    near = shell.own.distance_m[columns]
    incidence = (shell.own.normal[columns] * direction[columns]).sum(dim=-1).abs().clamp(min=1e-3)
    far = near + opening.depth_m / incidence

    owner = batch.wall_owner[item]
    wall_t = crossings.distance_m[columns]
    inner = (owner == slot[:, None]) & crossings.leaving[columns] & (wall_t > near[:, None] + 1e-4)
    jamb = (owner == -1 - decal[:, None]) & (wall_t <= far[:, None] + 1e-3)
    distance, wall = torch.where(inner | jamb, wall_t, torch.inf).min(dim=1)
    is_jamb = jamb.gather(1, wall[:, None])[:, 0]
    # A ray that slips between jamb and wall by rounding ends where it left.
    distance = torch.where(distance.isfinite(), distance, far)

    up = slope > 0.0
    head, ceiling = opening.z1_m - eye, room.ceiling_m - eye
    soffit = torch.where(up, head[:, None] / slope, torch.inf)
    plane = torch.where(up, ceiling[:, None], eye[:, None]) / slope.abs()
    in_soffit = soffit < far[:, None]
    plane = torch.where(in_soffit, soffit, plane)
    hit = torch.minimum(distance[:, None], plane)
    is_wall = distance[:, None] <= plane
    z = slope * hit + eye[:, None]

    surface = batch.wall_surface[item, wall][:, None].expand_as(hit)
    trim = opening.surface.long()[:, None]
    flat = torch.where(up, room.ceiling_surface[:, None], room.floor_surface[:, None]).long()
    surface = torch.where(is_wall, surface, torch.where(in_soffit, trim, flat))
    sub = batch[item]
    along = crossings.along_m[columns].gather(1, wall[:, None])
    painted = _decals_at(sub, wall[:, None], along)
    surface, _ = _paint(sub, painted, z[:, None], is_wall[:, None], surface[:, None])
    slot = torch.where(is_jamb[:, None] & is_wall, 0, slot[:, None]).expand_as(hit)
    for whole, part in (
        (shell.distance_m, hit),
        (shell.surface, surface[:, 0]),
        (shell.vertical, torch.where(is_wall, 0.0, torch.where(up, -1.0, 1.0))),
        (shell.slot, slot),
        (shell.is_beyond, torch.ones_like(slot)),
    ):
        whole[columns] = torch.where(hole >= 0, part.to(whole.dtype), whole[columns])
    shell.end_m[columns] = torch.maximum(shell.end_m[columns], distance)
    shell.beyond_normal[columns] = _facing_normal(sub.walls_m, wall[:, None], direction[columns][:, None])[:, 0]
