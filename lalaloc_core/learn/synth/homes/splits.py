"""Seeded homes for training, validation and test: home number i of a split is `default_rng([split, seed, i])`.

Training homes are `VARIED_HOMES`.
"""

from __future__ import annotations

import numpy as np

from lalaloc_core.learn.synth.homes.plans import VARIED_HOMES, Home, HomeConfig, generate_home

# Two splits never share a home.
TRAIN, VALIDATION, TEST = 0, 1, 2


def home_of(split: int, seed: int, index: int) -> tuple[Home, np.random.Generator]:
    """Return home number `index` of a split, and the generator for everything else that is drawn for it."""
    rng = np.random.default_rng([split, seed, index])
    return generate_home(rng, VARIED_HOMES if split == TRAIN else HomeConfig()), rng
