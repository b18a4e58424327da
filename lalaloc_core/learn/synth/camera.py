"""Camera model, from radiance to bytes: exposure, lenses, stitching, patches at the poles, compression."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.records import Records, columns

DISC, BLURRED, LOGO, MIRROR_BALL, TRIPOD, PERSON = range(6)
_NADIR_SHARES = (0.4, 0.15, 0.15, 0.08, 0.12, 0.1)
_NADIR_REACH_DEG = {TRIPOD: (25.0, 55.0), PERSON: (35.0, 65.0)}
_NADIR_RADIUS_DEG = (6.0, 30.0)
_MAX_TILT_DEG = 2.0


class Exposure(Records):
    """Settings that turn light into a picture.

    Attributes:
        target: mean brightness of the exposed picture.
        red_gain, tint, blue_gain: white balance, factors on the three channels.
        contrast, saturation: factors.
        noise: standard deviation.
        blur: standard deviation of the lens blur, pixels.
        nadir, nadir_tone, nadir_kind, nadir_turn: radius (radians, 0 for none), tone, kind and rotation of the patch
            over the nadir.
        noise_seed: part of the noise that is used.
        shoulder: softness of the roll-off of highlights.
        flatness: compression of the range of brightness.
        vignette: darkening towards the rims of the two lenses.
        seam, seam_step, seam_shift: azimuth of the seam between the lenses relative to the picture's centre, the step
            in brightness and the shift in elevation (radians) across it.
        roll, pitch: tilt about the forward axis and about the axis to the right, radians.
        jpeg: quality of compression, 0 for none.
        zenith, zenith_tone: radius (radians, 0 for none) and tone of the patch over the zenith.
    """

    target, red_gain, blue_gain, contrast, saturation, noise, blur = columns(7)
    nadir, nadir_tone, noise_seed, shoulder, tint, flatness, vignette = columns(7)
    seam, seam_step, seam_shift, roll, pitch, jpeg = columns(6)
    nadir_kind, nadir_turn, zenith, zenith_tone = columns(4)


def sample_exposure(rng: np.random.Generator, *, bright: bool = False) -> Exposure:
    """Sample camera settings; `bright` exposes like pictures of homes for sale, light, with compressed contrasts."""
    exposure = Exposure(np.zeros(Exposure.WIDTH))
    exposure.target = math.exp(rng.normal(math.log(0.42), 0.42))
    if bright:
        exposure.target = math.exp(rng.normal(math.log(0.7), 0.3))
    exposure.red_gain, exposure.blue_gain = np.exp(rng.normal(0.0, 0.09, 2))
    exposure.tint = math.exp(rng.normal(0.0, 0.02))
    exposure.contrast = rng.uniform(0.85, 1.25)
    exposure.saturation = rng.uniform(0.5, 1.25)
    exposure.noise = 0.03 * rng.random() ** 3
    exposure.blur = rng.uniform(0.0, 0.9)
    exposure.noise_seed = rng.integers(1 << 20)
    exposure.shoulder = rng.uniform(0.2, 1.0)
    if rng.random() < (0.6 if bright else 0.3):
        exposure.flatness = rng.uniform(0.1, 0.5)
    _sample_lenses(exposure, rng)
    _sample_stand(exposure, rng)
    return exposure


def sample_staged_exposure(rng: np.random.Generator) -> Exposure:
    """Sample settings for rendered pictures of one data set: similar, level, without seams and tripods."""
    exposure = sample_exposure(rng)
    exposure.target = math.sqrt(0.5 * exposure.target)
    exposure.saturation = 0.5 + 0.5 * exposure.saturation
    exposure.nadir = exposure.zenith = exposure.roll = exposure.pitch = exposure.jpeg = 0.0
    exposure.seam_step = exposure.seam_shift = exposure.vignette = exposure.flatness = 0.0
    return exposure


def without_stitching(exposure: Exposure) -> Exposure:
    """Return settings (torch) without what stitched spheres have: seams, rims of two lenses, tilt, covered poles."""
    changed = Exposure(exposure.rows.clone())
    for name in ("nadir", "zenith", "roll", "pitch", "seam_step", "seam_shift", "vignette"):
        setattr(changed, name, 0.0)
    return changed


def _sample_lenses(exposure: Exposure, rng: np.random.Generator) -> None:
    exposure.seam = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.5:
        exposure.vignette = rng.uniform(0.03, 0.4)
    if rng.random() < 0.3:
        exposure.seam_step = rng.normal(0.0, 0.06)
        exposure.seam_shift = math.radians(float(np.clip(rng.normal(0.0, 0.4), -1.2, 1.2)))
    if rng.random() < 0.5:
        tilt = np.clip(rng.normal(0.0, 0.8, 2), -_MAX_TILT_DEG, _MAX_TILT_DEG)
        exposure.roll, exposure.pitch = np.radians(tilt)
    if rng.random() < 0.4:
        exposure.jpeg = rng.uniform(50.0, 95.0)


def _sample_stand(exposure: Exposure, rng: np.random.Generator) -> None:
    if rng.random() < 0.38:
        kind = int(rng.choice(len(_NADIR_SHARES), p=_NADIR_SHARES))
        exposure.nadir_kind = kind
        exposure.nadir = math.radians(rng.uniform(*_NADIR_REACH_DEG.get(kind, _NADIR_RADIUS_DEG)))
        exposure.nadir_tone = rng.uniform(0.0, 0.08) if rng.random() < 0.6 else rng.uniform(0.0, 0.95)
        exposure.nadir_turn = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.06:
        exposure.zenith = math.radians(rng.uniform(5.0, 20.0))
        exposure.zenith_tone = rng.uniform(0.0, 0.9)


_BLOCK = 8
_LUMA = (
    *(16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29),
    *(51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121),
    *(120, 101, 72, 92, 95, 98, 112, 100, 103, 99),
)
_CHROMA = (
    *(17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66),
    *((99,) * 38),
)
# From RGB to luma and two differences of colour.
_TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))


def compress(picture: Float[Tensor, "b h w 3"], quality: Float[Tensor, "b"]) -> Float[Tensor, "b h w 3"]:
    """Compress pictures in 0..1 at a `quality` of 1 to 100, without chroma sub-sampling."""
    rows, columns = picture.shape[1:3]
    matrix = picture.new_tensor(_TO_YCC)
    planes = (picture * 255.0 - 128.0) @ matrix.T
    planes = torch.nn.functional.pad(
        planes.permute(0, 3, 1, 2), (0, -columns % _BLOCK, 0, -rows % _BLOCK), mode="replicate"
    )
    blocks = planes.unflatten(3, (-1, _BLOCK)).unflatten(2, (-1, _BLOCK)).transpose(3, 4)
    # One product of (64, 64) for both axes at once is faster than two small ones for every block.
    cosines = _cosines(picture)
    steps = _steps(picture, quality).flatten(2)[:, :, None, None]
    rounded = (blocks.flatten(4) @ cosines.T).div_(steps).round_().mul_(steps)
    planes = (rounded @ cosines).unflatten(4, (_BLOCK, _BLOCK)).transpose(3, 4).flatten(4, 5).flatten(2, 3)
    planes = planes[:, :, :rows, :columns].permute(0, 2, 3, 1)
    return ((planes @ torch.linalg.inv(matrix).T + 128.0) / 255.0).clamp_(0.0, 1.0)


def _cosines(like: Tensor) -> Float[Tensor, "64 64"]:
    """Return the orthonormal discrete cosine transform of flattened blocks."""
    k = torch.arange(_BLOCK, device=like.device, dtype=like.dtype)
    table = torch.cos((k[None] + 0.5) * k[:, None] * (math.pi / _BLOCK)) * math.sqrt(2.0 / _BLOCK)
    table[0] *= math.sqrt(0.5)
    return torch.kron(table, table)


def _steps(like: Tensor, quality: Float[Tensor, "b"]) -> Float[Tensor, "b 3 8 8"]:
    scale = torch.where(quality < 50.0, 5000.0 / quality.clamp(min=1.0), 200.0 - 2.0 * quality)
    tables = like.new_tensor([_LUMA, _CHROMA, _CHROMA]).reshape(3, _BLOCK, _BLOCK)
    return ((tables * scale[:, None, None, None] + 50.0) / 100.0).floor().clamp(min=1.0)


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
    where(inside & (kind == BLURRED), picture + soft * (mean - picture))
    where(inside & (kind == MIRROR_BALL), ball)
    where(inside & ((kind == DISC) | (kind == LOGO)), tone.expand_as(picture))
    ring = ((share - 0.75).abs() < 0.06) | ((share < 0.5) & ((3.0 * turned).cos() > 0.1))
    where(ring & (kind == LOGO), (1.0 - tone).expand_as(picture))
    # Legs of one thickness come together below the camera.
    from_leg = torch.remainder(turned + math.pi / 3.0, TWO_PI / 3.0) - math.pi / 3.0
    legs = (from_leg.abs() * polar.sin() < 0.035) | (share < 0.25)
    where(inside & legs & (kind == TRIPOD), 0.3 * tone.expand_as(picture))
    from_body = torch.remainder(turned + math.pi, TWO_PI) - math.pi
    body = (from_body.abs() < 0.28 - 0.12 * share) | (share < 0.2)
    cloth = tone * picture.new_tensor([0.5, 0.55, 0.7])
    where(inside & body & (kind == PERSON), cloth.expand_as(picture))
    at_zenith = (math.pi - polar) < exposure.zenith[:, None, None]
    where(at_zenith, exposure.zenith_tone[:, None, None, None].expand_as(picture))
    return picture


def _ball(picture: Float[Tensor, "b h w 3"], share: Float[Tensor, "b h 1"]) -> Float[Tensor, "b h w 3"]:
    """Return the reflection in a mirrored ball below the camera: ceiling in the middle, room towards the rim."""
    rows = picture.shape[1]
    from_zenith = 2.0 * torch.asin(share.clamp(max=1.0)) / math.pi
    row = (from_zenith * rows).long().clamp(max=rows - 1)
    return 0.85 * picture.gather(1, row[..., None].expand_as(picture))


_LUMA_SHARES = (0.2126, 0.7152, 0.0722)
_MIDDLE_GREY = 0.6
# Width (radians) over which one lens is blended into the other.
_BLEND = 0.05


def develop(
    radiance: Float[Tensor, "b h w 3"], exposure: Exposure, noise: Float[Tensor, "bh bw 3"]
) -> UInt8[Tensor, "b h w 3"]:
    """Expose linear radiance and encode it as sRGB-like bytes; every picture uses its own rolled part of `noise`."""
    luma = radiance @ radiance.new_tensor(_LUMA_SHARES)
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
