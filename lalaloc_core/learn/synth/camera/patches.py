"""Patches over the poles of a sphere: discs, logos, a mirrored ball, tripod legs, the photographer."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.camera import exposure as E
from lalaloc_core.learn.synth.camera.exposure import Exposure


def cover_poles(picture: Float[Tensor, "b h w 3"], exposure: Exposure) -> Float[Tensor, "b h w 3"]:
    """Lay the patches of `exposure` over nadir and zenith of encoded pictures."""
    covered = ((exposure.nadir > 0.0) | (exposure.zenith > 0.0)).nonzero(as_tuple=True)[0]
    if len(covered):
        picture[covered] = _cover(picture[covered], exposure[covered])
    return picture


def _cover(picture: Float[Tensor, "b h w 3"], exposure: Exposure) -> Float[Tensor, "b h w 3"]:
    rows, columns = picture.shape[1:3]
    polar = ((torch.arange(rows, device=picture.device) + 0.5) / rows * math.pi).flip(0)[None, :, None]
    azimuth = ((torch.arange(columns, device=picture.device) + 0.5) / columns * TWO_PI)[None, None]
    reach = exposure.nadir[:, None, None]
    tone = exposure.nadir_tone[:, None, None, None]
    kind, turned = exposure.nadir_kind[:, None, None], azimuth - exposure.nadir_turn[:, None, None]
    share = polar / reach.clamp(min=1e-6)
    inside = share < 1.0

    def where(mask: Tensor, other: Tensor) -> None:
        nonlocal picture
        picture = torch.where(mask[..., None], other, picture)

    ball = _ball(picture, share)
    mean = (
        (picture * inside[..., None]).sum(dim=(1, 2), keepdim=True)
        / (inside.sum(dim=(1, 2)) + 1e-6)[:, None, None, None]
        * (1.0 / columns)
    )
    soft = (4.0 * (1.0 - share)).clamp(0.0, 1.0)[..., None]
    where(inside & (kind == E.BLURRED), picture + soft * (mean - picture))
    where(inside & (kind == E.MIRROR_BALL), ball)
    where(inside & ((kind == E.DISC) | (kind == E.LOGO)), tone.expand_as(picture))
    ring = ((share - 0.75).abs() < 0.06) | ((share < 0.5) & ((3.0 * turned).cos() > 0.1))
    where(ring & (kind == E.LOGO), (1.0 - tone).expand_as(picture))
    # Legs of one thickness come together below the camera.
    from_leg = torch.remainder(turned + math.pi / 3.0, TWO_PI / 3.0) - math.pi / 3.0
    legs = (from_leg.abs() * polar.sin() < 0.035) | (share < 0.25)
    where(inside & legs & (kind == E.TRIPOD), 0.3 * tone.expand_as(picture))
    from_body = torch.remainder(turned + math.pi, TWO_PI) - math.pi
    body = (from_body.abs() < 0.28 - 0.12 * share) | (share < 0.2)
    cloth = tone * picture.new_tensor([0.5, 0.55, 0.7])
    where(inside & body & (kind == E.PERSON), cloth.expand_as(picture))
    at_zenith = (math.pi - polar) < exposure.zenith[:, None, None]
    where(at_zenith, exposure.zenith_tone[:, None, None, None].expand_as(picture))
    return picture


def _ball(picture: Float[Tensor, "b h w 3"], share: Float[Tensor, "b h 1"]) -> Float[Tensor, "b h w 3"]:
    """Return the reflection in a mirrored ball below the camera: ceiling in the middle, room towards the rim."""
    rows = picture.shape[1]
    from_zenith = 2.0 * torch.asin(share.clamp(max=1.0)) / math.pi
    row = (from_zenith * rows).long().clamp(max=rows - 1)
    return 0.85 * picture.gather(1, row[..., None].expand_as(picture))
