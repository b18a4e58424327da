"""Averaged weights: what is validated and shipped where averaging is on."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel


def moving_average(module: nn.Module, decay: float) -> AveragedModel:
    """Exponential moving average of all weights and statistics of a module, in evaluation mode.

    `update_parameters` after every step; the average begins with the weights that the module has now.

    Args:
        decay: per step; the first steps decay faster.
    """

    def update(averaged: Iterable[Tensor], current: Iterable[Tensor], count: Tensor | int) -> None:
        # Early steps would weigh too long at full decay.
        share = 1.0 - min(decay, (1.0 + int(count)) / (10.0 + int(count)))
        for average, value in zip(averaged, current, strict=True):
            if average.is_floating_point():
                average.lerp_(value, share)
            else:
                average.copy_(value)

    average = AveragedModel(module, multi_avg_fn=update, use_buffers=True).eval()
    resume_average(average, 0)
    return average


def resume_average(average: AveragedModel, step: int) -> None:
    """Go on with an average after so many steps; the weights that it began with count as one of them."""
    average.n_averaged.fill_(1 + step)
