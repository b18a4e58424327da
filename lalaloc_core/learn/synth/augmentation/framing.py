"""Random cameras that show a part of a level picture: fields of view, tilt, and the pixels that they see."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

# Horizontal fields of view (degrees) of phones, from their long to their widest lens, and shares of width to height.
_FIELD_DEG = (50.0, 112.0)
_ASPECTS = (4.0 / 3.0, 16.0 / 9.0, 3.0 / 2.0)
_PORTRAIT_SHARE = 0.5
# Portrait pictures show less of the horizon: range of their fields of view.
_PORTRAIT_FIELD_DEG = (40.0, 80.0)
# Normal spreads and limits of pitch and roll (degrees).
_PITCH_DEG, _MAX_PITCH_DEG = 8.0, 20.0
_ROLL_DEG, _MAX_ROLL_DEG = 2.0, 5.0
# Normal spread (degrees) of the error that remains when a picture has been levelled.
_LEVEL_ERROR_DEG = 0.7
# Share of pictures that show the whole patch, as spheres do.
_WHOLE_SHARE = 0.15


def framed(
    images: Float[Tensor, "b h w 3"],
    azimuths: Float[Tensor, "w"],
    elevations: Float[Tensor, "h"],
    generator: torch.Generator,
) -> Float[Tensor, "b h w 4"]:
    """Show each picture through a random camera, level but for a small error.

    Args:
        images: pictures, 0 to 255.
        azimuths: azimuth of each column relative to the centre, radians.
        elevations: elevation of each row, radians.
        generator: source of randomness, on the pictures' device.

    Returns:
        RGB and opacity, 0 to 255; pixels outside the camera's picture are transparent.
    """
    count, device = len(images), images.device

    def normal(spread_deg: float, limit_deg: float) -> Tensor:
        drawn = spread_deg * torch.randn(count, generator=generator, device=device)
        return torch.deg2rad(drawn.clamp(-limit_deg, limit_deg))

    error = _rotation(normal(_LEVEL_ERROR_DEG, 3.0), normal(_LEVEL_ERROR_DEG, 3.0))
    shown = _rotated(images, azimuths, elevations, error)
    camera = _rotation(normal(_PITCH_DEG, _MAX_PITCH_DEG), normal(_ROLL_DEG, _MAX_ROLL_DEG))
    seen = _seen(_rays(azimuths, elevations), camera, *_lenses(count, device, generator))
    seen |= (torch.rand(count, generator=generator, device=device) < _WHOLE_SHARE)[:, None, None]
    return torch.cat([shown, 255.0 * seen[..., None].to(shown.dtype)], dim=3)


def seen_by(
    azimuths: Float[Tensor, "w"], elevations: Float[Tensor, "h"], across_deg: float, up_deg: float
) -> Bool[Tensor, "h w"]:
    """Return the pixels in the picture of a level camera with these horizontal and vertical fields of view."""
    across, up = (torch.tan(torch.deg2rad(torch.tensor([degrees / 2.0]))) for degrees in (across_deg, up_deg))
    return _seen(_rays(azimuths, elevations), torch.eye(3)[None], across, up)[0]


def _lenses(count: int, device: torch.device, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw the tangents of half the horizontal and half the vertical field of view."""

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, device=device)

    aspects = torch.tensor(_ASPECTS, device=device)
    aspect = aspects[torch.randint(len(_ASPECTS), (count,), generator=generator, device=device)]
    portrait = torch.rand(count, generator=generator, device=device) < _PORTRAIT_SHARE
    field = torch.where(portrait, uniform(*_PORTRAIT_FIELD_DEG), uniform(*_FIELD_DEG))
    across = torch.tan(torch.deg2rad(field) / 2.0)
    return across, torch.where(portrait, across * aspect, across / aspect)


def _rays(azimuths: Tensor, elevations: Tensor) -> Float[Tensor, "h w 3"]:
    """Return the direction of each pixel: right, ahead, up."""
    flat = torch.cos(elevations)[:, None]
    right, ahead = flat * torch.sin(azimuths), flat * torch.cos(azimuths)
    return torch.stack([right, ahead, torch.sin(elevations)[:, None].expand_as(right)], dim=2)


def _rotation(pitch: Float[Tensor, "b"], roll: Float[Tensor, "b"]) -> Float[Tensor, "b 3 3"]:
    """Return matrices from level directions to those of a camera with pitch (up) and roll (clockwise)."""
    zero, one = torch.zeros_like(pitch), torch.ones_like(pitch)
    raised = torch.stack(
        [one, zero, zero, zero, pitch.cos(), pitch.sin(), zero, -pitch.sin(), pitch.cos()], dim=1
    ).view(-1, 3, 3)
    turned = torch.stack([roll.cos(), zero, -roll.sin(), zero, one, zero, roll.sin(), zero, roll.cos()], dim=1).view(
        -1, 3, 3
    )
    return turned @ raised


def _seen(
    rays: Float[Tensor, "h w 3"], camera: Float[Tensor, "b 3 3"], across: Float[Tensor, "b"], up: Float[Tensor, "b"]
) -> Bool[Tensor, "b h w"]:
    """Return the pixels in a camera's picture, by the tangents of half its fields of view."""
    x, y, z = torch.einsum("bij,hwj->ibhw", camera, rays)
    ahead = y.clamp(min=1e-6)
    return (y > 0.0) & ((x / ahead).abs() < across[:, None, None]) & ((z / ahead).abs() < up[:, None, None])


def _rotated(
    images: Float[Tensor, "b h w 3"], azimuths: Tensor, elevations: Tensor, rotation: Float[Tensor, "b 3 3"]
) -> Float[Tensor, "b h w 3"]:
    """Resample pictures under small rotations; what comes from beyond a border repeats it."""
    right, ahead, up = torch.einsum("bij,hwj->ibhw", rotation, _rays(azimuths, elevations))
    azimuth, elevation = torch.atan2(right, ahead), torch.asin(up.clamp(-1.0, 1.0))
    # From the centres of the outermost pixels, at -1 and 1 when corners are aligned.
    x = 2.0 * (azimuth - azimuths[0]) / (azimuths[-1] - azimuths[0]) - 1.0
    y = 2.0 * (elevation - elevations[0]) / (elevations[-1] - elevations[0]) - 1.0
    planes = images.permute(0, 3, 1, 2)
    grid = torch.stack([x, y], dim=3)
    return functional.grid_sample(planes, grid, padding_mode="border", align_corners=True).permute(0, 2, 3, 1)
