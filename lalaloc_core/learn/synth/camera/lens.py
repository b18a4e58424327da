"""Two stitched lenses: darker rims, a seam, and a tilted horizon."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.camera.exposure import Exposure

# Width (radians) over which one lens is blended into the other.
_BLEND = 0.05


def lens_gain(exposure: Exposure, rows: int, columns: int) -> Float[Tensor, "b h w"]:
    """Return the gain of each pixel: darker towards the rims, one lens brighter than the other."""
    azimuth, elevation = _angles(rows, columns, exposure.rows)
    from_seam = azimuth - exposure.seam[:, None]
    # The axes of the lenses lie at right angles to the seam.
    from_axis = torch.acos((elevation.cos()[None, :, None] * from_seam.sin().abs()[:, None]).clamp(max=1.0))
    rim = 1.0 - exposure.vignette[:, None, None] * (from_axis * (2.0 / math.pi)) ** 3
    return rim * (1.0 + exposure.seam_step[:, None] * _second_lens(from_seam))[:, None]


def tilt(picture: Float[Tensor, "b h w 3"], exposure: Exposure) -> Float[Tensor, "b h w 3"]:
    """Resample the picture for a camera with roll and pitch whose second lens is shifted."""
    rows, columns = picture.shape[1:3]
    azimuth, elevation = _angles(rows, columns, exposure.rows)
    shift = exposure.seam_shift[:, None] * _second_lens(azimuth - exposure.seam[:, None])
    raised = elevation[None, :, None] + shift[:, None]
    right = azimuth.sin()[None, None] * raised.cos()
    ahead = azimuth.cos()[None, None] * raised.cos()
    up = raised.sin()
    roll, pitch = exposure.roll[:, None, None], exposure.pitch[:, None, None]
    right, up = right * roll.cos() + up * roll.sin(), up * roll.cos() - right * roll.sin()
    ahead, up = ahead * pitch.cos() - up * pitch.sin(), up * pitch.cos() + ahead * pitch.sin()
    # One column more on either side, so that sampling goes around.
    x = torch.atan2(right, ahead) * (columns / TWO_PI / (0.5 * columns + 1.0))
    y = torch.asin(up.clamp(-1.0, 1.0)) * (-2.0 / math.pi)
    planes = torch.nn.functional.pad(picture.permute(0, 3, 1, 2), (1, 1, 0, 0), mode="circular")
    grid = torch.stack([x, y], dim=-1)
    seen = torch.nn.functional.grid_sample(planes, grid, align_corners=False, padding_mode="border")
    return seen.permute(0, 2, 3, 1)


def _angles(rows: int, columns: int, like: Tensor) -> tuple[Float[Tensor, "w"], Float[Tensor, "h"]]:
    """Return the azimuth of the columns relative to the picture's centre, and the elevation of the rows."""
    column = torch.arange(columns, device=like.device, dtype=like.dtype)
    row = torch.arange(rows, device=like.device, dtype=like.dtype)
    return ((column + 0.5) / columns - 0.5) * TWO_PI, (0.5 - (row + 0.5) / rows) * math.pi


def _second_lens(from_seam: Float[Tensor, "b w"]) -> Float[Tensor, "b w"]:
    """Return 1 where the second lens looks, 0 where the first does."""
    return torch.sigmoid(from_seam.sin() * (4.0 / _BLEND))
