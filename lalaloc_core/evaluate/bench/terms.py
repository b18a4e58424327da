"""What each term of the evidence is worth, and what a camera height is that is wrong or not told."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lalaloc_core.evaluate.bench.accuracy import Benchmark, answers_to, summary_of
from lalaloc_core.localise.bundle import Bundle

# Rows by the settings of method "lalaloc" that make them. What a plan or a model does not tell changes nothing.
TERMS: Mapping[str, Mapping[str, Any]] = {
    "all": {},
    "without_openings": {"openings": False},
    "without_see_through": {"see_through": False},
    "without_ceiling": {"ceiling": False},
    "without_room_type": {"room_type": False},
    "walls_alone": {"openings": False, "see_through": False, "ceiling": False, "room_type": False},
}
HEIGHTS: Mapping[str, Mapping[str, Any]] = {
    "right": {},
    "20_cm_too_high": {"camera_height_error_m": 0.2},
    "20_cm_too_low": {"camera_height_error_m": -0.2},
    "not_told": {"camera_height": "unknown"},
}
_HEADINGS = {"known_heading": True, "unknown_heading": False}


def bench_terms(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Accuracy with and without each term, heading known and unknown, on the test split and out-of-family."""
    return {
        family: _rows(bundle, TERMS, homes, textures, heldout=heldout)
        for family, heldout in (("test", False), ("out_of_family", True))
    }


def bench_heights(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Accuracy on the test split at camera heights that are told right, wrong and not at all."""
    return {"test": _rows(bundle, HEIGHTS, homes, textures, heldout=False)}


def bench_copies(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Which of four copies of a home that differ in where their doors are, with and without openings."""
    rows = {name: TERMS[name] for name in ("all", "without_openings")}
    return {"test": _rows(bundle, rows, homes, textures, heldout=False, copies=True)}


def _rows(
    bundle: Bundle,
    rows: Mapping[str, Mapping[str, Any]],
    homes: int,
    textures: Path | None,
    *,
    heldout: bool,
    copies: bool = False,
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for heading, known in _HEADINGS.items():
        found[heading] = {}
        for name, settings in rows.items():
            benchmark = Benchmark(
                settings=settings,
                heading_known=known,
                heldout=heldout,
                copies=copies,
                minor=heldout or copies,
            )
            found[heading][name] = summary_of(answers_to(bundle, benchmark, homes, textures))
    return found
