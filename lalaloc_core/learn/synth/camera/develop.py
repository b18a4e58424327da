"""Radiance to an 8-bit picture: exposure, white balance, lenses, tone curve, blur, noise, patches, compression."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.camera.exposure import Exposure
from lalaloc_core.learn.synth.camera.jpeg import compress
from lalaloc_core.learn.synth.camera.patches import cover_poles

_LUMA = (0.2126, 0.7152, 0.0722)
_MIDDLE_GREY = 0.6
# Width (radians) over which one lens is blended into the other.
_BLEND = 0.05


def develop(
    radiance: Float[Tensor, "b h w 3"], exposure: Exposure, noise: Float[Tensor, "bh bw 3"]
) -> UInt8[Tensor, "b h w 3"]:
    """Expose linear radiance and encode it as sRGB-like bytes.

    `noise` is unit noise, at least as large as a picture; every picture uses its own rolled part.
    """
    luma = radiance @ radiance.new_tensor(_LUMA)
    # Like a light meter, the mean of logarithms weighs a dark room more than its bright window.
    luma = luma.clamp_(1e-3, 20.0).log_()
    mean = luma.mean(dim=(1, 2))
    level = mean.exp()
    gains = torch.stack([exposure.red_gain, exposure.tint, exposure.blue_gain], dim=-1)
    gains = gains * (_MIDDLE_GREY * exposure.target / level)[:, None]
    flatter = torch.exp(exposure.flatness[:, None, None] * (mean[:, None, None] - luma))
    _replace(
        flatter,
        exposure,
        (exposure.vignette != 0.0) | (exposure.seam_step != 0.0),
        lambda some, camera: some * lens_gain(camera, *some.shape[1:]),
    )
    picture = _blur(radiance * gains[:, None, None] * flatter[..., None], exposure.blur)
    own = exposure[:, None, None, None]
    # Highlights roll off instead of clipping hard; how softly differs between cameras.
    shoulder = own.shoulder
    picture = (picture * (0.25 * shoulder)).add_(1.0).mul_(picture).div_((picture * shoulder).add_(1.0))
    picture = picture.clamp_(0.0, 1.0).pow_(1.0 / 2.2)
    grey = picture.mean(dim=-1, keepdim=True)
    contrast, saturation = own.contrast, own.saturation
    # Saturation scales the distance to grey, contrast the distance to one half.
    picture = picture.mul_(contrast * saturation).add_(grey * (contrast * (1.0 - saturation)) + 0.5 * (1.0 - contrast))
    is_tilted = (exposure.roll != 0.0) | (exposure.pitch != 0.0) | (exposure.seam_shift != 0.0)
    _replace(picture, exposure, is_tilted, tilt)
    picture.add_(_own_noise(noise, exposure, picture.shape[1], picture.shape[2]).mul_(own.noise))
    picture = cover_poles(picture, exposure).clamp_(0.0, 1.0)
    _replace(picture, exposure, exposure.jpeg > 0.0, lambda some, camera: compress(some, camera.jpeg))
    return picture.mul_(255.0).round_().to(torch.uint8)


def _replace(
    picture: Float[Tensor, "b h w *c"],
    exposure: Exposure,
    wanted: Bool[Tensor, "b"],
    change: Callable[[Tensor, Exposure], Tensor],
) -> None:
    """Change the selected pictures in place."""
    chosen = wanted.nonzero(as_tuple=True)[0]
    if len(chosen):
        picture[chosen] = change(picture[chosen], exposure[chosen])


def _blur(picture: Float[Tensor, "b h w 3"], sigma: Float[Tensor, "b"]) -> Float[Tensor, "b h w 3"]:
    """Blur with a separable three-tap kernel, wrapped around the seam."""
    side = (0.5 * sigma**2 / (1.0 + sigma**2))[:, None, None, None]
    across = picture.roll(1, 2).add_(picture.roll(-1, 2)).mul_(side)
    picture = across.add_(picture * (1.0 - 2.0 * side))
    above, below = picture[:, :-2], picture[:, 2:]
    inner = (above + below).mul_(side).add_(picture[:, 1:-1] * (1.0 - 2.0 * side))
    return torch.cat([picture[:, :1], inner, picture[:, -1:]], dim=1)


def _own_noise(noise: Tensor, exposure: Exposure, rows: int, columns: int) -> Float[Tensor, "b h w 3"]:
    parts = []
    for seed in exposure.noise_seed.long().tolist():
        top, left = seed % (noise.shape[0] - rows + 1), (seed // 7) % (noise.shape[1] - columns + 1)
        parts.append(noise[top : top + rows, left : left + columns])
    return torch.stack(parts)


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
