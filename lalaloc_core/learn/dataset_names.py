"""Splits, formats and sizes of data sets; importing it loads no data set, so the command line can list them."""

from __future__ import annotations

from typing import Literal, get_args

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
# Formats by their name on the command line.
DATASET_FORMATS = {
    "structured3d": "Structured3D",
    "zind": "ZInD",
    "own": "own data",
    "annotated": "annotated photographs",
    "posed": "posed spheres",
}
# Out-of-distribution homes.
HELDOUT_HOMES = 60
# Galleries of every annotated photograph.
GALLERIES = 3
