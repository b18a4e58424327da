"""The networks that training left in a run's folder."""

from __future__ import annotations

from pathlib import Path

from lalaloc_core.learn.training.stages import build_layout_encoder
from lalaloc_core.learn.training.warm_start import checkpoint_with
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.decoder import LayoutDecoder


def load_layout_encoder_of(folder: Path, *, last: bool = False) -> LayoutEncoder:
    """The layout encoder that training left in a run's folder: the best by validation, unless the last is asked for."""
    checkpoint = checkpoint_with("layout", folder, last=last)
    encoder = build_layout_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.inference_weights["layout_encoder"])
    return encoder


def load_decoder_of(folder: Path, *, last: bool = False) -> LayoutDecoder | None:
    """The decoder that was trained with `load_layout_encoder_of`, where one was."""
    checkpoint = checkpoint_with("layout", folder, last=last)
    if "decoder" not in checkpoint.inference_weights:
        return None
    decoder = LayoutDecoder(checkpoint.config.latent_size)
    decoder.load_state_dict(checkpoint.inference_weights["decoder"])
    return decoder
