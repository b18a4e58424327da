"""The networks of both architectures, and loading a layout encoder from a bundle's weights."""

from __future__ import annotations

from typing import Any

import safetensors.torch

from lalaloc_core.nets.resnet import PaperConfig, PaperLayoutEncoder
from lalaloc_core.nets.ring import RingConfig, RingLayoutEncoder


def load_layout_encoder(
    architecture: str, config: dict[str, Any], weights: bytes
) -> RingLayoutEncoder | PaperLayoutEncoder:
    """Rebuild a layout encoder from the configuration and the safetensors of a bundle.

    Raises:
        ValueError: unknown architecture.
        RuntimeError: the weights do not fit.
    """
    sizes = {name: tuple(value) if isinstance(value, list) else value for name, value in config.items()}
    if architecture == "ring":
        encoder: RingLayoutEncoder | PaperLayoutEncoder = RingLayoutEncoder(RingConfig(**sizes))
    elif architecture == "paper":
        encoder = PaperLayoutEncoder(PaperConfig(**sizes))
    else:
        raise ValueError(f"unknown architecture '{architecture}', known are 'ring' and 'paper'")
    state = safetensors.torch.load(weights)
    # Half precision is a storage format here; arithmetic is single precision.
    encoder.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()}, strict=True)
    return encoder
