"""Draw docs/images/turn.jpg: a turn in the example flat, and its place by one photograph and by all of them.

Run `python -m examples.turn_picture` after a change of the flat, the renderer or the model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from examples.truth import FOLDER, PLAN_PATH
from lalaloc_core import LaLaLoc, StatedCamera, read_plan
from lalaloc_core.draw.answer import draw_answer, drawn_answer
from lalaloc_core.draw.canvas import MUTED, document, image, jpeg, pixels, words
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.photograph.cameras import Perspective

_COUNT, _FIELD_DEG, _SIZE = 12, 53.0, (360, 480)
_SPHERE = FOLDER / "bedroom.jpg"
# Size of the picture's parts, pixels.
_WIDTH, _GAP, _HEAD = 1200, 12, 40
_PICTURE, _QUALITY = FOLDER.parent / "docs" / "images" / "turn.jpg", 85


def main() -> None:
    plan, model, frames = read_plan(PLAN_PATH), LaLaLoc(), _frames()
    files = [encode_jpeg(frame) for frame in frames]
    camera = StatedCamera(projection="perspective", hfov_deg=_FIELD_DEG)
    answers = [model.localise(plan, files[0], camera=camera), model.localise_turn(plan, files, camera=camera)]
    drawn = [pixels(draw_answer(drawn_answer(answer), None, "plan")) for answer in answers]
    _write(frames, list(zip(drawn, (answer.confidence or 0.0 for answer in answers), strict=True)))


def _frames() -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return the photographs that a phone takes once around."""
    with Image.open(_SPHERE) as picture:
        sphere = np.asarray(picture.convert("RGB"))
    camera = Perspective.of_hfov(*_SIZE, math.radians(_FIELD_DEG))
    turns = (2.0 * math.pi * number / _COUNT for number in range(_COUNT))
    return [cut_view(sphere, camera, azimuth=turn, pitch=0.0, roll=0.0) for turn in turns]


def _write(frames: Sequence[UInt8[np.ndarray, "h w 3"]], plans: Sequence[tuple[Image.Image, float]]) -> None:
    """Compose the photographs above the plans."""
    width = (_WIDTH - _GAP) / _COUNT - _GAP
    tall = width * _SIZE[1] / _SIZE[0]
    parts = [
        image(jpeg(frame), "jpeg", (_GAP + number * (width + _GAP), _GAP, width, tall))
        for number, frame in enumerate(frames)
    ]
    half, top = (_WIDTH - _GAP) / len(plans) - _GAP, 2 * _GAP + tall
    below = 0.0
    for number, ((plan, confidence), text) in enumerate(
        zip(plans, ("The first photograph alone", f"All {_COUNT}, taken while turning"), strict=True)
    ):
        left = _GAP + number * (half + _GAP)
        high = half * plan.height / plan.width
        parts.append(words(left, top + 26, f"{text}: confidence {100.0 * confidence:.0f} %", 20, fill=MUTED))
        parts.append(image(jpeg(np.asarray(plan.convert("RGB"))), "jpeg", (left, top + _HEAD, half, high)))
        below = max(below, top + _HEAD + high + _GAP)
    drawing = pixels(document(_WIDTH, round(below), "A turn on the spot and its place", parts))
    drawing.save(_PICTURE, quality=_QUALITY, optimize=True)
    print(_PICTURE)


if __name__ == "__main__":
    main()
