"""The networks of both architectures, and loading a layout encoder from a bundle's weights."""

from __future__ import annotations

from typing import Any

import safetensors.torch

from lalaloc_core.configuration import build_config
from lalaloc_core.nets.resnet import PaperConfig, PaperImageEncoder, PaperLayoutEncoder
from lalaloc_core.nets.ring import RingConfig, RingImageEncoder, RingLayoutEncoder

LayoutEncoder = RingLayoutEncoder | PaperLayoutEncoder
ImageEncoder = RingImageEncoder | PaperImageEncoder


def load_layout_encoder(architecture: str, config: dict[str, Any], weights: bytes) -> LayoutEncoder:
    """Rebuild a layout encoder from the configuration and the safetensors of a bundle.

    Raises:
        ValueError: unknown architecture, or a configuration that is not one (`ConfigError`).
        RuntimeError: the weights do not fit.
    """
    if architecture == "ring":
        encoder: LayoutEncoder = RingLayoutEncoder(build_config(RingConfig, config))
    elif architecture == "paper":
        encoder = PaperLayoutEncoder(build_config(PaperConfig, config))
    else:
        raise ValueError(f"unknown architecture '{architecture}', known are 'ring' and 'paper'")
    state = safetensors.torch.load(weights)
    # Half precision is a storage format here; arithmetic is single precision.
    encoder.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()}, strict=True)
    return encoder
