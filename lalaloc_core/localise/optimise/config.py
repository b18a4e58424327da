"""Settings of the optimisers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class LpoConfig:
    """Settings of both optimisers.

    Attributes:
        margin_m: poses keep this distance to walls, so that none ends on the other side of one.
        max_iterations: evaluations of Levenberg-Marquardt at most, the first at the start.
        profile_iterations, exact_cost: so many where wall profiles are compared, and more for poses of less than this
            cost alone: what is predicted errs by more than the last steps gain, unless it fits so well.
        tolerance_m: a Levenberg-Marquardt step shorter than this ends the search.
        tolerance_cost: and so does one that lowers the cost by less than this share, or would by the linear model.
        max_step_m, max_turn: longest step (m) and turn (radians) per iteration.
        prune_after, prune_ratio: after so many evaluations, starts farther than the best by this factor are left
            where they are: they will not become the answer.
        prune_margin: the same of wall profiles, by how much their cost exceeds the best; it is a log likelihood.
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
