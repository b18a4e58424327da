"""Ray casting against vertical boxes and elliptic cylinders, column by column; see `cast` for the layout."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lalaloc_core.learn.synth.scene.render_scene import Prisms

_TINY = 1e-9
_TIE_M = 1e-5
_MAX_PRISMS_PER_COLUMN = 16


@dataclass(frozen=True, eq=False)
class PrismHits:
    """Nearest prisms per column: entry and exit distance, z-range, index, normal of the entered side."""

    enter_m: Float[Tensor, "b c k"]
    leave_m: Float[Tensor, "b c k"]
    z0_m: Float[Tensor, "b c k"]
    z1_m: Float[Tensor, "b c k"]
    index: Int[Tensor, "b c k"]
    normal: Float[Tensor, "b c k 2"]


def cross_prisms(prisms: Prisms, direction: Float[Tensor, "b c 2"], limit_m: Float[Tensor, "b c"]) -> PrismHits:
    """Intersect every column with the footprints of the prisms and keep the nearest ones before `limit_m`."""
    each = prisms[:, None]
    x, y, ax, ay, a, b = each.x_m, each.y_m, each.axis_x, each.axis_y, each.half_a_m, each.half_b_m
    dx, dy = direction[:, :, None, 0], direction[:, :, None, 1]
    # The ray in the prism's own frame, scaled so that the footprint is the unit square or the unit disc.
    u, v = -(x * ax + y * ay) / a, -(y * ax - x * ay) / b
    du, dv = (dx * ax + dy * ay) / a, (dy * ax - dx * ay) / b
    box_enter, box_leave, through_u = _cross_square(u, v, du, dv)
    disc_enter, disc_leave = _cross_disc(u, v, du, dv)
    is_round = each.is_round > 0.5
    enter, leave = torch.where(is_round, disc_enter, box_enter), torch.where(is_round, disc_leave, box_leave)
    valid = (enter < leave) & (leave > 0.0) & (enter < limit_m[:, :, None])
    most = min(max(int(valid.sum(dim=2).max()), 1), _MAX_PRISMS_PER_COLUMN)
    # If a ray enters two prisms at once, as in one piece of furniture, the first one counts.
    order = torch.where(valid, enter + _TIE_M * torch.arange(enter.shape[2], device=enter.device), torch.inf)
    index = order.topk(most, dim=2, largest=False).indices
    enter = torch.where(valid, enter, torch.inf).gather(2, index)
    leave = torch.where(valid, leave, -torch.inf).gather(2, index)

    def pick(column: Tensor) -> Tensor:
        return column.expand(-1, index.shape[1], -1).gather(2, index)

    ax, ay, a, b = pick(ax), pick(ay), pick(a), pick(b)
    du, dv, through_u = du.gather(2, index), dv.gather(2, index), through_u.gather(2, index)
    start = torch.where(enter.isfinite(), enter, 0.0)
    u = u.expand_as(valid).gather(2, index) + start * du
    v = v.expand_as(valid).gather(2, index) + start * dv
    is_round = is_round.expand_as(valid).gather(2, index)
    nu = torch.where(is_round, u / a, torch.where(through_u, -du.sign(), 0.0))
    nv = torch.where(is_round, v / b, torch.where(through_u, 0.0, -dv.sign()))
    length = torch.sqrt(nu**2 + nv**2) + _TINY
    nu, nv = nu / length, nv / length
    normal = torch.stack([nu * ax - nv * ay, nu * ay + nv * ax], dim=-1)
    return PrismHits(
        enter_m=enter, leave_m=leave, z0_m=pick(each.z0_m), z1_m=pick(each.z1_m), index=index, normal=normal
    )


def _cross_square(u: Tensor, v: Tensor, du: Tensor, dv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return entry and exit of the unit square, and if it is entered through a side of constant u."""
    iu, iv = 1.0 / torch.where(du.abs() < _TINY, _TINY, du), 1.0 / torch.where(dv.abs() < _TINY, _TINY, dv)
    mid_u, half_u = -u * iu, iu.abs()
    mid_v, half_v = -v * iv, iv.abs()
    enter_u, enter_v = mid_u - half_u, mid_v - half_v
    return torch.maximum(enter_u, enter_v), torch.minimum(mid_u + half_u, mid_v + half_v), enter_u > enter_v


def _cross_disc(u: Tensor, v: Tensor, du: Tensor, dv: Tensor) -> tuple[Tensor, Tensor]:
    """Return entry and exit of the unit disc; entry after exit for a miss."""
    square = du**2 + dv**2
    mid = -(u * du + v * dv) / square
    discriminant = 1.0 - (u * dv - v * du) ** 2 / square
    half = torch.sqrt(discriminant.clamp(min=0.0) / square)
    half = torch.where(discriminant > 0.0, half, -1.0)
    return mid - half, mid + half


def resolve_prisms(
    prisms: PrismHits, limit_m: Float[Tensor, "b c h"], slope: Float[Tensor, "h"], eye_m: Float[Tensor, "b"]
) -> tuple[Float[Tensor, "b c h"], Int[Tensor, "b c h"]]:
    """Find the nearest prism before `limit_m` along each ray.

    The upper half of the rows must look up and the lower half down.

    Returns:
        distance (m, `limit_m` where nothing is hit) and the prism's place among the column's (-1: nothing).
    """
    batch, columns, rows = limit_m.shape
    halves = (batch, columns, 2, rows // 2)
    inverse = (1.0 / slope).reshape(2, -1)
    best = limit_m.reshape(halves).clone()
    nearest = torch.full_like(best, -1, dtype=torch.int8)
    bottom, top = prisms.z0_m - eye_m[:, None, None], prisms.z1_m - eye_m[:, None, None]
    # A ray that climbs meets the underside first, one that falls meets the top first.
    first_z, last_z = torch.stack([bottom, top], dim=3), torch.stack([top, bottom], dim=3)
    enter, leave = prisms.enter_m.clamp(min=1e-3)[..., None, None], prisms.leave_m[..., None, None]
    for k in range(prisms.enter_m.shape[2]):
        start = torch.maximum(first_z[:, :, k, :, None] * inverse, enter[:, :, k])
        end = torch.minimum(last_z[:, :, k, :, None] * inverse, leave[:, :, k])
        hit = start < torch.minimum(end, best)
        best = torch.where(hit, start, best)
        nearest.masked_fill_(hit, k)
    return best.reshape(limit_m.shape), nearest.reshape(limit_m.shape).long()


def gap_behind(prisms: PrismHits, limit_m: Float[Tensor, "b c h"]) -> Float[Tensor, "b c h"]:
    """Return the distance from a point on the floor to the next piece of furniture that stands behind it."""
    stands = (prisms.z0_m < 0.12) & (prisms.z1_m > 0.05)
    enter = torch.where(stands, prisms.enter_m, torch.inf).sort(dim=2).values
    enter = torch.nn.functional.pad(enter, (0, 1), value=torch.inf)
    following = torch.searchsorted(enter, limit_m.contiguous()).clamp(max=enter.shape[2] - 1)
    return enter.gather(2, following) - limit_m
