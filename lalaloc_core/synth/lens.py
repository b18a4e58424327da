"""What two stitched lenses do to a panorama: rims that are darker, a seam, and a horizon that is not quite level."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.synth import exposure as E

# Width (radians) over which one lens is blended into the other.
_BLEND = 0.05


def lens_gain(exposure: Float[Tensor, "b 24"], rows: int, columns: int) -> Float[Tensor, "b h w"]:
    """Factor on the light of each pixel: darker towards the rims of the lenses, one lens brighter than the other."""
    azimuth, elevation = _angles(rows, columns, exposure)
    from_seam = azimuth - exposure[:, E.SEAM, None]
    # The axes of the lenses lie at right angles to the seam.
    from_axis = torch.acos((elevation.cos()[None, :, None] * from_seam.sin().abs()[:, None]).clamp(max=1.0))
    rim = 1.0 - exposure[:, E.VIGNETTE, None, None] * (from_axis * (2.0 / math.pi)) ** 3
    return rim * (1.0 + exposure[:, E.SEAM_STEP, None] * _second_lens(from_seam))[:, None]


def tilt(picture: Float[Tensor, "b h w 3"], exposure: Float[Tensor, "b 24"]) -> Float[Tensor, "b h w 3"]:
    """The picture of a camera with `ROLL` and `PITCH`, whose second lens is shifted by `SEAM_SHIFT`, resampled."""
    rows, columns = picture.shape[1:3]
    azimuth, elevation = _angles(rows, columns, exposure)
    shift = exposure[:, E.SEAM_SHIFT, None] * _second_lens(azimuth - exposure[:, E.SEAM, None])
    raised = elevation[None, :, None] + shift[:, None]
    right = azimuth.sin()[None, None] * raised.cos()
    ahead = azimuth.cos()[None, None] * raised.cos()
    up = raised.sin()
    roll, pitch = exposure[:, E.ROLL, None, None], exposure[:, E.PITCH, None, None]
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
    """Azimuth of the columns relative to the picture's centre, and elevation of the rows."""
    column = torch.arange(columns, device=like.device, dtype=like.dtype)
    row = torch.arange(rows, device=like.device, dtype=like.dtype)
    return ((column + 0.5) / columns - 0.5) * TWO_PI, (0.5 - (row + 0.5) / rows) * math.pi


def _second_lens(from_seam: Float[Tensor, "b w"]) -> Float[Tensor, "b w"]:
    """1 where the second lens looks, 0 where the first does."""
    return torch.sigmoid(from_seam.sin() * (4.0 / _BLEND))
