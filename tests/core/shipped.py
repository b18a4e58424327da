"""The shipped model, opened once in a process, and level views of the example spheres."""

from __future__ import annotations

import math
from functools import cache

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size, sphere_size
from lalaloc_core.photograph import Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import jpeg, sphere, take

FIELD_DEG = 80.0


@cache
def bundle() -> Bundle:
    return Bundle.open(default_bundle())


@cache
def encoder() -> PhotographEncoder:
    return PhotographEncoder(bundle(), threads=1)


def level_view(
    name: str, heading_deg: float, tilt_deg: float | None = None, *, width: int = 640, height: int = 480
) -> Photograph:
    """Return a level view of a sphere, `FIELD_DEG` wide, whose tilt is stated or estimated."""
    camera = Perspective.of_hfov(width, height, math.radians(FIELD_DEG))
    return open_photograph(
        jpeg(take(sphere(name), camera, heading_deg=heading_deg)),
        sphere_size=sphere_size(bundle().manifest),
        patch_size=patch_size(bundle().manifest),
        stated=StatedCamera(projection="perspective", hfov_deg=FIELD_DEG, pitch_deg=tilt_deg, roll_deg=tilt_deg),
    )
