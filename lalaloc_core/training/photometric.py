"""Cheap random changes of exposure, contrast, colour and noise, for a whole batch on its device."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

# Spreads (normal) of the logarithms at full strength, and of the noise's standard deviation (share of the range).
_GAIN, _GAMMA, _BALANCE, _CONTRAST = 0.12, 0.15, 0.04, 0.12
_NOISE = 0.01


def changed(image: UInt8[Tensor, "b h w 3"], strength: float, generator: torch.Generator) -> Float[Tensor, "b h w 3"]:
    """Panoramas (0 to 255) as another camera or another hour would have shown them.

    Args:
        strength: 0 changes nothing, 1 by up to a third of the exposure or so.
        generator: source of randomness, on the pictures' device.
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
