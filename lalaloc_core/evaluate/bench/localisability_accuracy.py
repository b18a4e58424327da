"""Share of photographs that the model finds, beside the share that the plan alone predicts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import Bundle
from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.evaluate.calibrate.measured_errors import outcomes_of, predicted_shares
from lalaloc_core.localise.localisability.predicted_localisability import errors_of

# Each spot is localised six times.
_MAX_HOMES = 65
_RESAMPLES = 2000


def bench_localisability(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Compare both shares in furnished test homes, at most 65, with 4 spots each.

    `interval` is the 95 % interval of the predicted minus the found share, by resampling homes.
    """
    homes = min(homes, _MAX_HOMES)
    outcomes = outcomes_of(bundle, homes, "test", textures)
    predicted = predicted_shares(bundle.manifest, errors_of(bundle.manifest), [outcome.spot for outcome in outcomes])
    rng, rows = np.random.default_rng(0), dict[str, Any]()
    for name in CONDITIONS:
        found = np.array([float(outcome.found[name]) for outcome in outcomes])
        rows[name] = {
            "found": float(found.mean()),
            "predicted": float(predicted[name].mean()),
            "interval": difference_interval(predicted[name] - found, homes, rng),
        }
    difference = [abs(row["found"] - row["predicted"]) for row in rows.values()]
    return {"n": len(outcomes), "mean_difference": float(np.mean(difference)), **rows}


def difference_interval(
    difference: Float[np.ndarray, "n"], homes: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % interval of the mean difference of spots, which are sorted by home."""
    by_home = difference.reshape(homes, -1).mean(axis=1)
    means = by_home[rng.integers(homes, size=(_RESAMPLES, homes))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)
