"""Mix a checkpoint's weights with those of an earlier bundle of the same training.

`python -m scripts.blend_weights RUN EARLIER_BUNDLE SHARE OUT` writes a run folder to `lalaloc export` from. Its image
encoder has `SHARE` of RUN's weights and the rest of EARLIER_BUNDLE's. Training on renderings forgets some of what the
pretrained trunk knew of photographs; weights between the two keep most of both (Wortsman et al., "Robust fine-tuning
of zero-shot models", CVPR 2022).
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import torch
from safetensors.torch import load_file

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.training.best import best_path
from lalaloc_core.learn.training.checkpoint import Checkpoint


def blended(
    weights: dict[str, torch.Tensor], earlier: dict[str, torch.Tensor], share: float
) -> dict[str, torch.Tensor]:
    """`share` (0 to 1) of `weights` and the rest of `earlier`, tensor by tensor; whole numbers stay as they are.

    Raises:
        InvalidInputError: the share is out of range, or both are not of one network.
    """
    if not 0.0 <= share <= 1.0:
        raise InvalidInputError(f"the share is {share:g}, it must lie within 0 and 1")
    if {name: value.shape for name, value in weights.items()} != {name: value.shape for name, value in earlier.items()}:
        raise InvalidInputError("both sets of weights must be of the same network")
    return {
        name: torch.lerp(earlier[name].float(), value.float(), share).to(value.dtype)
        if value.is_floating_point()
        else value
        for name, value in weights.items()
    }


def main() -> None:
    """Blend as the command line says."""
    run, bundle, out = Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[4])
    earlier = load_file(bundle / "image_encoder.safetensors")
    checkpoint = Checkpoint.load(best_path(run / "image.pt"), stage="image")
    (name,) = checkpoint.inference_weights
    checkpoint.inference_weights[name] = blended(checkpoint.inference_weights[name], earlier, float(sys.argv[3]))
    checkpoint.save(out / "image.pt")
    shutil.copy(run / "layout.pt", out / "layout.pt")


if __name__ == "__main__":
    main()
