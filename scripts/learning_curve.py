"""Draw the learning curve of docs/results.md: `python -m scripts.learning_curve LOG.csv PICTURE.png`."""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

_PANELS = {
    "negative log likelihood of the wall profile": {
        "validation": "val_nll",
        "out-of-family": "heldout_nll",
    },
    "nearest grid pose within 1 m, by profile": {
        "full": "val_profile_within_1m_full",
        "simple": "val_profile_within_1m_simple",
        "empty": "val_profile_within_1m_empty",
        "out-of-family, full": "heldout_profile_within_1m",
    },
    "nearest grid pose within 1 m, by latent": {
        "full": "val_within_1m_full",
        "simple": "val_within_1m_simple",
        "empty": "val_within_1m_empty",
        "out-of-family, full": "heldout_within_1m",
    },
}


def main() -> None:
    """Draw the curve named on the command line."""
    log, picture = map(Path, sys.argv[1:])
    draw(read(log), picture)


def read(log: Path) -> dict[str, list[tuple[float, float]]]:
    """Minutes of training and values, by name."""
    values: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with log.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            values[row["name"]].append((float(row["seconds"]) / 60.0, float(row["value"])))
    return values


def draw(values: dict[str, list[tuple[float, float]]], picture: Path) -> None:
    """One panel per kind of figure, one line per split and furniture level."""
    figure = Figure(figsize=(13.0, 3.6), layout="constrained")
    for axes, (title, lines) in zip(figure.subplots(1, len(_PANELS)), _PANELS.items(), strict=True):
        for label, name in lines.items():
            minutes, value = zip(*values[name], strict=True)
            axes.plot(minutes, value, marker=".", label=label)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("minutes of training")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    main()
