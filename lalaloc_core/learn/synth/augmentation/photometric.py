"""Photometric augmentation: cheap random effects of camera, lens and file for a whole batch on its device."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.camera.jpeg import compress

# Spreads (normal) of the logarithms at full strength, and of the noise's standard deviation (share of the range).
_GAIN, _GAMMA, _BALANCE, _CONTRAST = 0.12, 0.15, 0.04, 0.12
_NOISE = 0.01
# Share of compressed pictures: compression is the most expensive effect.
_JPEG_SHARE = 0.25


def jittered(image: UInt8[Tensor, "b h w 3"], strength: float, generator: torch.Generator) -> Float[Tensor, "b h w 3"]:
    """Change exposure, colour and noise of spheres at random.

    `strength` 0 changes nothing, 1 changes the exposure by about a third. The generator is on the pictures' device.
    """

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
    pixels = pixels * _lenses(
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


def _lenses(
    columns: int, vignette: Float[Tensor, "b"], step: Float[Tensor, "b"], seam: Float[Tensor, "b"]
) -> Float[Tensor, "b 1 w 1"]:
    """Return the gain of each column: darker towards the seams of two lenses, one lens brighter than the other."""
    azimuth = (torch.arange(columns, device=seam.device) + 0.5) * (TWO_PI / columns) + seam[:, None]
    gain = (1.0 - vignette[:, None] * azimuth.cos().abs() ** 3) * (1.0 + step[:, None] * azimuth.cos().sign())
    return gain[:, None, :, None]


def _blurred(pixels: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b h w 3"]:
    """Return the mean of 3 x 3 pixels, wrapped around the horizon."""
    around = torch.cat([pixels[:, :, -1:], pixels, pixels[:, :, :1]], dim=2)
    wide = around[:, :, :-2] + around[:, :, 1:-1] + around[:, :, 2:]
    over = torch.cat([wide[:, :1], wide, wide[:, -1:]], dim=1)
    return (over[:, :-2] + over[:, 1:-1] + over[:, 2:]) / 9.0
