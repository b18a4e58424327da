"""Settings of the optimisers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class LpoConfig:
    """Settings of both optimisers.

    Attributes:
        method: the optimiser.
        margin_m: smallest distance of poses to walls, so that none crosses one.
        max_iterations: maximum number of Levenberg-Marquardt evaluations, including the first at the start.
        profile_iterations: the same for wall profiles, as predictions are less accurate than the last steps.
        exact_cost: poses below this cost continue up to `max_iterations`.
        tolerance_m: a Levenberg-Marquardt step shorter than this ends the search.
        tolerance_cost: a step that lowers the cost by less than this share, or would by the linear model, ends it too.
        initial_damping: damping of the first step.
        max_step_m, max_turn: longest step (m) and turn (radians) per iteration.
        prune_after: number of evaluations after which starts that cannot become the answer are left.
        prune_ratio: such starts are farther than the best by this factor.
        prune_margin: the same for wall profiles: their cost exceeds the best by this.
        adam_*: the paper's schedule.
    """

    method: Literal["levenberg-marquardt", "adam"] = "levenberg-marquardt"
    margin_m: float = 0.03
    max_iterations: int = 15
    profile_iterations: int = 4
    exact_cost: float = 0.01
    tolerance_m: float = 1e-3
    tolerance_cost: float = 1e-2
    initial_damping: float = 1e-2
    max_step_m: float = 0.5
    max_turn: float = 0.2
    prune_after: int = 3
    prune_ratio: float = 1.5
    prune_margin: float = 0.6
    adam_learning_rate: float = 0.01
    adam_steps: int = 150
    adam_plateau_threshold: float = 0.05
    adam_plateau_patience: int = 10
    adam_stop_threshold: float = 0.001
    adam_stop_patience: int = 20
