"""Loaders for layout encoders and decoders from a bundle's weights."""

from __future__ import annotations

from typing import Any

import safetensors.torch
from torch import nn

from lalaloc_core.bundle import DECODER_WEIGHTS, Bundle
from lalaloc_core.configuration import build_config
from lalaloc_core.errors import BundleError
from lalaloc_core.nets.layout_network import LayoutDecoder, RingConfig, RingLayoutEncoder
from lalaloc_core.nets.paper_encoders import PaperConfig, PaperLayoutEncoder

LayoutNetwork = RingLayoutEncoder | PaperLayoutEncoder


def load_layout_encoder(architecture: str, config: dict[str, Any], weights: bytes) -> LayoutNetwork:
    """Rebuild a layout encoder from the configuration and the safetensors of a bundle.

    Raises:
        ValueError: unknown architecture, or an invalid configuration (`ConfigError`).
        RuntimeError: the weights do not fit.
    """
    if architecture in ("ring", "trunk"):
        encoder: LayoutNetwork = RingLayoutEncoder(build_config(RingConfig, config))
    elif architecture == "paper":
        encoder = PaperLayoutEncoder(build_config(PaperConfig, config))
    else:
        raise ValueError(f"unknown architecture '{architecture}'; it must be 'ring', 'trunk' or 'paper'")
    _load_weights(encoder, weights)
    return encoder


def load_decoder(bundle: Bundle) -> LayoutDecoder:
    """Load the decoder that a bundle's layout encoder was trained with."""
    decoder = LayoutDecoder(bundle.manifest.latent_size)
    try:
        _load_weights(decoder, bundle.read(DECODER_WEIGHTS))
    except RuntimeError as error:
        raise BundleError(f"bundle '{bundle.folder}': the decoder's weights do not fit: {error}") from error
    return decoder.eval()


def _load_weights(module: nn.Module, weights: bytes) -> None:
    state = safetensors.torch.load(weights)
    module.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()}, strict=True)
