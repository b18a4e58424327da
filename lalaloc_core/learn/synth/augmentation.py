"""Random changes of finished spheres, rendered or photographed: views of them, camera and file, stretched rooms."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.camera import compress

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
_WHOLE_SHARE = 0.1


def framed(
    images: Float[Tensor, "b h w 3"],
    azimuths: Float[Tensor, "w"],
    elevations: Float[Tensor, "h"],
    generator: torch.Generator,
) -> Float[Tensor, "b h w 4"]:
    """Show each picture through a random camera, level but for a small error.

    `azimuths` (radians) are relative to the centre. The fourth channel is opacity: pixels outside the camera's picture
    are transparent.
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

    def drawn(low: float, high: float) -> Tensor:
        # Alike by ratio, because the narrow ones are the hard ones.
        return low * (high / low) ** torch.rand(count, generator=generator, device=device)

    aspects = torch.tensor(_ASPECTS, device=device)
    aspect = aspects[torch.randint(len(_ASPECTS), (count,), generator=generator, device=device)]
    portrait = torch.rand(count, generator=generator, device=device) < _PORTRAIT_SHARE
    field = torch.where(portrait, drawn(*_PORTRAIT_FIELD_DEG), drawn(*_FIELD_DEG))
    across = torch.tan(torch.deg2rad(field) / 2.0)
    return across, torch.where(portrait, across * aspect, across / aspect)


def _rays(azimuths: Tensor, elevations: Tensor) -> Float[Tensor, "h w 3"]:
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


# Spreads (normal) of the logarithms at full strength, and of the noise's standard deviation (share of the range).
_GAIN, _GAMMA, _BALANCE, _CONTRAST = 0.12, 0.15, 0.04, 0.12
_NOISE = 0.01
# Share of compressed pictures: compression is the most expensive effect.
_JPEG_SHARE = 0.25


def jittered(image: UInt8[Tensor, "b h w 3"], strength: float, generator: torch.Generator) -> Float[Tensor, "b h w 3"]:
    """Change exposure, colour and noise of spheres at random; `strength` 0 changes nothing, 1 by about a third."""

    def drawn(spread: float, channels: int = 1) -> Tensor:
        size = (len(image), channels, 1)
        return strength * spread * torch.randn(size, generator=generator, device=image.device)

    # Values are bytes, so that a table of 256 per picture and channel says everything but the noise.
    value = torch.linspace(0.0, 1.0, 256, device=image.device)
    gain = torch.exp(drawn(_GAIN) + drawn(_BALANCE, 3))
    table = 0.5 + (gain * value ** torch.exp(drawn(_GAMMA)) - 0.5) * torch.exp(drawn(_CONTRAST))
    offset = 256 * torch.arange(3 * len(image), device=image.device).reshape(len(image), 1, 1, 3)
    pixels = table.flatten()[image.long() + offset]
    # One field of noise for all: drawing it for each would cost more than the rest.
    field = torch.randn(image.shape[1:], generator=generator, device=image.device)
    return 255.0 * (pixels + drawn(_NOISE)[..., None] * field).clamp(0.0, 1.0)


def optics(image: Float[Tensor, "b h w 3"], strength: float, generator: torch.Generator) -> Float[Tensor, "b h w 3"]:
    """Apply random effects of lens, film or file to spheres.

    Blur, vignetting of two lenses and a brightness step between them, clipped highlights, lifted shadows, pale or
    strong colours, JPEG; each for a share of the pictures. `strength` 0 changes nothing, 1 changes most pictures. The
    generator is on the pictures' device.
    """
    count, device = len(image), image.device

    def chance(share: float) -> Tensor:
        return (torch.rand(count, generator=generator, device=device) < strength * share).float()

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, device=device)

    def by_picture(value: Tensor) -> Tensor:
        return value[:, None, None, None]

    pixels = image / 255.0
    # A tone curve with a knee: values above it are spread or clipped.
    gain = torch.exp(chance(0.3) * uniform(-0.7, 0.7))
    pixels = (pixels * by_picture(gain)).clamp(max=1.0)
    lift = chance(0.3) * uniform(0.0, 0.25)
    pixels = by_picture(lift) + (1.0 - by_picture(lift)) * pixels
    pixels = pixels * _vignetting(
        image.shape[2], chance(0.3) * uniform(0.0, 0.4), chance(0.3) * uniform(-0.15, 0.15), uniform(0.0, TWO_PI)
    )
    saturation = 1.0 + chance(0.4) * uniform(-1.0, 0.5)
    grey = pixels.mean(dim=3, keepdim=True)
    pixels = grey + by_picture(saturation) * (pixels - grey)
    blurred = _blurred(pixels)
    share = by_picture(chance(0.3) * uniform(0.3, 1.0))
    pixels = (pixels + share * (blurred - pixels)).clamp(0.0, 1.0)
    squeezed = torch.rand(count, generator=generator, device=device) < strength * _JPEG_SHARE
    if bool(squeezed.any()):
        pixels[squeezed] = compress(pixels[squeezed], uniform(20.0, 90.0)[squeezed])
    return 255.0 * pixels


def _vignetting(
    columns: int, vignette: Float[Tensor, "b"], step: Float[Tensor, "b"], seam: Float[Tensor, "b"]
) -> Float[Tensor, "b 1 w 1"]:
    """Return the gain of each column: darker towards the seams of two lenses, one lens brighter than the other."""
    azimuth = (torch.arange(columns, device=seam.device) + 0.5) * (TWO_PI / columns) + seam[:, None]
    gain = (1.0 - vignette[:, None] * azimuth.cos().abs() ** 3) * (1.0 + step[:, None] * azimuth.cos().sign())
    return gain[:, None, :, None]


def _blurred(pixels: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b h w 3"]:
    around = torch.cat([pixels[:, :, -1:], pixels, pixels[:, :, :1]], dim=2)
    wide = around[:, :, :-2] + around[:, :, 1:-1] + around[:, :, 2:]
    over = torch.cat([wide[:, :1], wide, wide[:, -1:]], dim=1)
    return (over[:, :-2] + over[:, 1:-1] + over[:, 2:]) / 9.0


def stretched(
    images: UInt8[Tensor, "n h w 3"],
    openings: Float[Tensor, "n w k"],
    log_distance: Float[Tensor, "n w"],
    factors: Float[Tensor, "n 2"],
) -> tuple[UInt8[Tensor, "n h w 3"], Float[Tensor, "n w k"], Float[Tensor, "n w"]]:
    """Stretch spheres and their labels per column by (a, b), across and along the direction of the central column."""
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
    row = (0.5 - torch.atan(tangent[:, None] / reach[:, None, :]) / math.pi) * height - 0.5
    around = torch.cat([images[:, :, -1:], images, images[:, :, :1]], dim=2).permute(0, 3, 1, 2).float()
    # The first column of `around` is the last of the picture, and -1 to 1 reach from the edges of its edge pixels.
    x = (2.0 * (column % width) + 3.0) / (width + 2) - 1.0
    y = (2.0 * row + 1.0) / height - 1.0
    grid = torch.stack([x[:, None, :].expand_as(y), y], dim=3)
    seen = functional.grid_sample(around, grid, padding_mode="border", align_corners=False)
    return seen.permute(0, 2, 3, 1).round().to(torch.uint8)


def _seen_at(width: int, factors: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n w"], Float[Tensor, "n w"]]:
    """Return the source column of each column, and the source share of its distance.

    A point (x, y, z) moves to (a x, b y, z), so direction (u, v, t) shows the source direction (u / a, v / b, t).
    """
    azimuth = ((torch.arange(width) + 0.5) / width - 0.5) * TWO_PI
    across, along = torch.sin(azimuth) / factors[:, :1], torch.cos(azimuth) / factors[:, 1:]
    return (torch.atan2(across, along) / TWO_PI + 0.5) * width - 0.5, torch.hypot(across, along)
