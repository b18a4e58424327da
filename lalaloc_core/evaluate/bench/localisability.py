"""Share of photographs that the model finds, beside the share that the plan alone predicts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.evaluate.bench.prediction_errors import outcomes_of, predicted_shares
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.localisability import errors_of

# Each spot is localised six times.
_MAX_HOMES = 30


def bench_localisability(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Compare both shares in furnished test homes, at most 30, with 4 spots each."""
    outcomes = outcomes_of(bundle, min(homes, _MAX_HOMES), "test", textures)
    predicted = predicted_shares(bundle.manifest, errors_of(bundle.manifest), [outcome.spot for outcome in outcomes])
    rows: dict[str, Any] = {
        name: {"found": float(np.mean([outcome.found[name] for outcome in outcomes])), "predicted": predicted[name]}
        for name in CONDITIONS
    }
    difference = [abs(row["found"] - row["predicted"]) for row in rows.values()]
    return {"n": len(outcomes), "mean_difference": float(np.mean(difference)), **rows}
