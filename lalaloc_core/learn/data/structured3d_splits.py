"""Structured3D's official splits, and the scenes with known defects."""

from __future__ import annotations

from lalaloc_core.learn.data.dataset import Split

# Scene numbers of the official splits.
OFFICIAL: dict[Split, range] = {"train": range(3000), "validation": range(3000, 3250), "test": range(3250, 3500)}

# "Some scenes had corrupted data" (paper, section 5), as listed in the authors' published code.
EXCLUDED_BY_PAPER: dict[Split, tuple[int, ...]] = {
    "train": (
        *(278, 335, 379, 683, 1192, 1212, 1753, 1840, 1852, 1855, 2025),
        *(2110, 2205, 2209, 2223, 2309, 2339, 2357, 2401, 2593, 2956),
    ),
    "validation": (3086, 3117, 3121, 3239),
    "test": (3307,),
}

# "Invalid scenes" in the errata of the data set; scenes listed only here are kept so that results are comparable.
ERRATA = (1155, 1192, 1714, 1816, 1852, 3398)


def scene_numbers(split: Split) -> tuple[int, ...]:
    """Return the numbers of a split's scenes without those excluded by the paper: 2979, 246 and 249 remain."""
    excluded = set(EXCLUDED_BY_PAPER[split])
    return tuple(number for number in OFFICIAL[split] if number not in excluded)
