"""One sheet with every annotated photograph, what was drawn on it, and what a model reads there: to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Int
from PIL import Image

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.draw.photograph import Stroke, draw_strokes, wall_line
from lalaloc_core.evaluate.report.pictures import PREDICTED_COLOUR, TRUE_COLOUR
from lalaloc_core.evaluate.report.sheets import Thumbnail, draw_sheet
from lalaloc_core.evaluate.runs.galleries import GalleryAnswer, describe_answers
from lalaloc_core.evaluate.runs.photograph_reading import ReadPhotograph
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M

_HEIGHT, _WIDTH = 256, 512
CLASS_COLOURS = {"door": "#ff9f0a", "window": "#2f7bff", "passage": "#2bd158"}
# Rows (pixels) of the bars that show the classes along the top of a picture: the true ones, the predicted ones.
_TRUE_BAR, _PREDICTED_BAR, _BAR_WIDTH = 4.0, 13.0, 6.0
_KEY = {TRUE_COLOUR: "annotated walls", PREDICTED_COLOUR: "predicted walls"} | {
    colour: f"{name} (annotated above predicted)" for name, colour in CLASS_COLOURS.items()
}


def draw_photographs(
    title: str, read: Sequence[ReadPhotograph], answers: Mapping[str, Sequence[GalleryAnswer]]
) -> Image.Image:
    """One sheet with every photograph, the worst walls first.

    Args:
        answers: in galleries, by what they were asked with; part of the captions.
    """
    ordered = sorted(read, key=lambda one: -one.measures.median_error)
    return draw_sheet(title, _KEY, [Thumbnail(_picture(one), _caption(one, answers)) for one in ordered])


def _caption(one: ReadPhotograph, answers: Mapping[str, Sequence[GalleryAnswer]]) -> list[str]:
    measures, name = one.measures, one.photograph.name
    located = (f"{heading} {describe_answers(some, name)}" for heading, some in answers.items())
    return [
        f"{name} ({one.photograph.quality})",
        f"|Δ log d| {measures.median_error:.3f}, 90 % below {measures.error_90:.2f}, bias {measures.bias:+.3f}, "
        f"{measures.scale_ratio:.1f} times its scale",
        "in galleries, heading " + ", ".join(located),
    ]


def _picture(one: ReadPhotograph) -> Image.Image:
    """The photograph with floor and ceiling lines of both walls, and bars for what is in them."""
    photograph = one.photograph
    true_m = photograph.profile_m(one.measures.outline, _WIDTH)
    # Predicted at fewer columns than the picture has.
    at, known = ((np.arange(count) + 0.5) / count for count in (_WIDTH, len(one.profile_m)))
    predicted_m = np.exp(np.interp(at, known, np.log(one.profile_m), period=1.0))
    rises_m = [-CAMERA_HEIGHT_M]
    if photograph.has_flat_ceiling:
        rises_m.append(photograph.outlines[0].ceiling_height_m - CAMERA_HEIGHT_M)
    strokes = [
        Stroke([wall_line(profile, rise, _HEIGHT) for rise in rises_m], colour, width, width + 1.0)
        for profile, colour, width in ((true_m, TRUE_COLOUR, 3.0), (predicted_m, PREDICTED_COLOUR, 1.5))
    ]
    strokes += _bars(photograph.classes(_WIDTH), _TRUE_BAR)
    if one.class_scores is not None:
        likeliest = one.class_scores.argmax(axis=1)
        strokes += _bars(likeliest[np.arange(_WIDTH) * len(likeliest) // _WIDTH], _PREDICTED_BAR)
    return draw_strokes(photograph.photograph.image(_HEIGHT, _WIDTH), strokes)


def _bars(classes: Int[np.ndarray, "w"], row: float) -> list[Stroke]:
    """A bar for every stretch of columns of one class, along a row of the picture; walls have none."""
    edges = [0, *(np.flatnonzero(np.diff(classes)) + 1).tolist(), len(classes)]
    return [
        Stroke([np.array([[first, row], [last, row]])], CLASS_COLOURS[OPENING_CLASSES[classes[first]]], _BAR_WIDTH, 8.0)
        for first, last in pairwise(edges)
        if classes[first]
    ]
