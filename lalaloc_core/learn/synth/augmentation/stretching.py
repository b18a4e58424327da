"""Spheres of rooms stretched along two horizontal axes: "pano stretch" of HorizonNet (Sun et al., CVPR 2019)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from lalaloc_core.conventions import TWO_PI


def stretched(
    images: UInt8[Tensor, "n h w 3"],
    openings: Float[Tensor, "n w k"],
    log_distance: Float[Tensor, "n w"],
    factors: Float[Tensor, "n 2"],
) -> tuple[UInt8[Tensor, "n h w 3"], Float[Tensor, "n w k"], Float[Tensor, "n w"]]:
    """Stretch spheres and their labels per column about the camera.

    `openings` and `log_distance` are labels per column; `factors` are (a, b), across and along the direction of the
    central column.
    """
    width = images.shape[2]
    column, reach = _seen_at(width, factors)
    nearest = column.round().long() % width
    moved = openings.gather(1, nearest[..., None].expand_as(openings))
    return stretched_images(images, factors), moved, log_distance.gather(1, nearest) - torch.log(reach)


def stretched_images(images: UInt8[Tensor, "n h w 3"], factors: Float[Tensor, "n 2"]) -> UInt8[Tensor, "n h w 3"]:
    """Stretch spheres only, as `stretched`."""
    height, width = images.shape[1:3]
    column, reach = _seen_at(width, factors)
    tangent = torch.tan((0.5 - (torch.arange(height) + 0.5) / height) * math.pi)
    elevation = torch.atan(tangent[:, None] / reach[:, None, :])
    return _sampled(images, (0.5 - elevation / math.pi) * height - 0.5, column)


def _seen_at(width: int, factors: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n w"], Float[Tensor, "n w"]]:
    """Return the source column of each column, and the source share of its distance.

    A point (x, y, z) moves to (a x, b y, z), so direction (u, v, t) shows the source direction (u / a, v / b, t).
    """
    azimuth = ((torch.arange(width) + 0.5) / width - 0.5) * TWO_PI
    across, along = torch.sin(azimuth) / factors[:, :1], torch.cos(azimuth) / factors[:, 1:]
    return (torch.atan2(across, along) / TWO_PI + 0.5) * width - 0.5, torch.hypot(across, along)


def _sampled(
    images: UInt8[Tensor, "n h w 3"], row: Float[Tensor, "n h w"], column: Float[Tensor, "n w"]
) -> UInt8[Tensor, "n h w 3"]:
    """Sample pixels bilinearly, wrapped around the horizon."""
    height, width = images.shape[1:3]
    around = torch.cat([images[:, :, -1:], images, images[:, :, :1]], dim=2).permute(0, 3, 1, 2).float()
    # The first column of `around` is the last of the picture, and -1 to 1 reach from the edges of its edge pixels.
    x = (2.0 * (column % width) + 3.0) / (width + 2) - 1.0
    y = (2.0 * row + 1.0) / height - 1.0
    grid = torch.stack([x[:, None, :].expand_as(y), y], dim=3)
    seen = functional.grid_sample(around, grid, padding_mode="border", align_corners=False)
    return seen.permute(0, 2, 3, 1).round().to(torch.uint8)
