"""Draw the pictures of docs/how-to/take-photographs.md from an example panorama: usable, tilted, and incomplete.

Run `python -m examples.make_photographs` after a change of the examples.
"""

from __future__ import annotations

import math

import numpy as np
from PIL import Image

from examples.truth import FOLDER
from lalaloc_core.photograph.spheres import level

OUT = FOLDER.parent / "docs" / "images"
_WIDTH, _HEIGHT = 768, 384
_JPEG_QUALITY = 85
# Rotation of a tilted camera, and the part of a sphere in a phone's panorama mode.
_PITCH, _ROLL = math.radians(8.0), math.radians(6.0)
_PHONE_ROWS = slice(_HEIGHT // 3, 2 * _HEIGHT // 3)


def main() -> None:
    """Write all pictures."""
    OUT.mkdir(exist_ok=True)
    with Image.open(FOLDER / "kitchen.jpg") as picture:
        sphere = np.asarray(picture.convert("RGB").resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS))
    pictures = {
        "sphere": sphere,
        "tilted": level(sphere, pitch=_PITCH, roll=_ROLL),
        "phone": sphere[_PHONE_ROWS, : 2 * _WIDTH // 3],
    }
    for name, pixels in pictures.items():
        Image.fromarray(np.ascontiguousarray(pixels)).save(OUT / f"{name}.jpg", quality=_JPEG_QUALITY, optimize=True)


if __name__ == "__main__":
    main()
