"""Structured3D's official splits, and the scenes that are known to be bad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lalaloc_core.learn.data.dataset import Split

Source = Literal["paper", "errata"]

# Scene numbers of the official splits.
OFFICIAL: dict[Split, range] = {"train": range(3000), "validation": range(3000, 3250), "test": range(3250, 3500)}

# "Some scenes had corrupted data" (paper, section 5); which ones is in the code that the authors published.
EXCLUDED_BY_PAPER: dict[Split, tuple[int, ...]] = {
    "train": (
        *(278, 335, 379, 683, 1192, 1212, 1753, 1840, 1852, 1855, 2025),
        *(2110, 2205, 2209, 2223, 2309, 2339, 2357, 2401, 2593, 2956),
    ),
    "validation": (3086, 3117, 3121, 3239),
    "test": (3307,),
}

# "Invalid scenes" in the errata of the data set itself.
ERRATA = (1155, 1192, 1714, 1816, 1852, 3398)


@dataclass(frozen=True, kw_only=True)
class BadScene:
    """A scene that somebody found bad.

    Attributes:
        number: of the scene.
        split: the official split it belongs to.
        sources: who says so.
        excluded: whether it is left out, as the paper does; the others are kept so that results compare.
    """

    number: int
    split: Split
    sources: tuple[Source, ...]

    @property
    def excluded(self) -> bool:
        return "paper" in self.sources


def bad_scenes() -> tuple[BadScene, ...]:
    """Every scene that somebody found bad, in order."""
    by_paper = {number for numbers in EXCLUDED_BY_PAPER.values() for number in numbers}
    found = []
    for split, numbers in OFFICIAL.items():
        for number in sorted(by_paper.union(ERRATA).intersection(numbers)):
            said = {"paper": number in by_paper, "errata": number in ERRATA}
            sources: tuple[Source, ...] = tuple(source for source in ("paper", "errata") if said[source])
            found.append(BadScene(number=number, split=split, sources=sources))
    return tuple(found)


def scene_numbers(split: Split) -> tuple[int, ...]:
    """Numbers of a split's scenes without the excluded ones: 2979, 246 and 249, as in the paper."""
    excluded = set(EXCLUDED_BY_PAPER[split])
    return tuple(number for number in OFFICIAL[split] if number not in excluded)
