"""One palette of walls, doors, windows and passages on all grounds, distinct for colour-blind readers."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageColor

from lalaloc_core.draw.canvas import ON_PAPER, ON_PHOTOGRAPH

STYLE = (Path(__file__).parents[2] / "web" / "src" / "style.css").read_text(encoding="utf-8")
LIGHT, DARK = STYLE.split("@media (prefers-color-scheme: dark)", 1)
KINDS = ("wall", "door", "window", "passage")
# Smallest distance in CIELAB between two colours of one ground; 2.3 is just noticeable.
MIN_DISTANCE = 20.0
# Machado, Oliveira and Fernandes (2009), severity 1, for linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.119192, 0.9503041]]
)


def _colours(sheet: str, prefix: str = "") -> dict[str, str]:
    found = {kind: re.search(rf"--{prefix}{kind}: (#[0-9a-f]{{6}});", sheet) for kind in KINDS}
    return {kind: match[1] for kind, match in found.items() if match is not None}


def _lab(colour: str, vision: np.ndarray) -> np.ndarray:
    rgb = np.array(ImageColor.getrgb(colour)) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(vision @ linear, 0.0, 1.0) / TO_XYZ.sum(axis=1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


def test_page_has_the_colours_of_pictures() -> None:
    assert _colours(LIGHT) == ON_PAPER
    assert _colours(LIGHT, "over-") == ON_PHOTOGRAPH
    # The lines over photographs are the same in the dark.
    assert _colours(DARK, "over-") == {}


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize(
    ("colours", "ground"),
    [(ON_PAPER, "#ffffff"), (_colours(DARK), "#171e26"), (ON_PHOTOGRAPH, None)],
    ids=["paper", "dark", "photograph"],
)
def test_colours_are_distinct_for_colour_blind_readers(
    vision: str, colours: dict[str, str], ground: str | None
) -> None:
    assert set(colours) == set(KINDS)
    shown = colours if ground is None else colours | {"ground": ground}
    distances = {
        pair: float(np.linalg.norm(_lab(shown[pair[0]], VISION[vision]) - _lab(shown[pair[1]], VISION[vision])))
        for pair in itertools.combinations(shown, 2)
    }
    assert {pair: distance for pair, distance in distances.items() if distance < MIN_DISTANCE} == {}


def test_doors_are_brown_and_windows_blue_as_the_importer_reads_them() -> None:
    for colours in (ON_PAPER, ON_PHOTOGRAPH):
        (door_red, _, door_blue), (window_red, _, window_blue) = (
            ImageColor.getrgb(colours[kind])[:3] for kind in ("door", "window")
        )
        assert door_red > door_blue + 60
        assert window_blue > window_red + 60
