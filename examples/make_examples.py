"""Render the example spheres and photographs of a phone, and write the spheres' true poses.

Run `python -m examples.make_examples` after a change of the flat, the views or the renderer. The flat was drawn by
hand, and no training data contains its plan, furniture or lighting.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image

from examples.truth import FOLDER, PLAN_PATH, TruePose, write_poses
from lalaloc_core.floorplan import FloorPlan, OpeningFace
from lalaloc_core.learn.data.views import cut_view
from lalaloc_core.learn.synth.homes import Home, Opening, OpeningKind
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.photograph.cameras import Perspective

HEIGHT, WIDTH = 512, 1024
# Rays per pixel and axis, for smooth edges.
_SUPERSAMPLE = 2
_JPEG_QUALITY = 90
_MATERIALS_SEED = 7
# Doors that stand open in the pictures, by their number among the openings of the plan.
_OPEN_DOORS = (0, 5)
_KINDS: Mapping[str, OpeningKind] = {"door": "door_shut", "passage": "opening", "window": "window"}


@dataclass(frozen=True, kw_only=True)
class View:
    """Sphere: its file, its camera pose, and the seed of furniture, materials and lighting."""

    file: str
    position_m: tuple[float, float]
    heading_deg: float
    camera_height_m: float
    seed: int


VIEWS = (
    View(file="living_room.jpg", position_m=(2.15, 2.3), heading_deg=30.0, camera_height_m=1.5, seed=15),
    View(file="kitchen.jpg", position_m=(7.1, 2.2), heading_deg=250.0, camera_height_m=1.5, seed=25),
    View(file="bedroom.jpg", position_m=(2.6, 6.75), heading_deg=120.0, camera_height_m=1.6, seed=37),
    View(file="study.jpg", position_m=(7.7, 7.6), heading_deg=340.0, camera_height_m=1.4, seed=43),
)

# Photographs by a phone's 0.5x lens, which their EXIF data name, held by hand: one, and the azimuths of a turn's.
PHONE = View(file="phone.jpg", position_m=(2.9, 1.5), heading_deg=335.0, camera_height_m=1.45, seed=15)
TURN_DEG = {"turn_1.jpg": 0.0, "turn_2.jpg": 50.0, "turn_3.jpg": 100.0, "turn_4.jpg": 150.0}
_PHONE_FOCAL_MM = 13
# Focal lengths of other formats are stated for equal diagonals: 4:3 is 34.6 mm wide where film is 36 by 24.
_PHONE_HFOV = 2.0 * math.atan(0.5 * 0.8 * math.hypot(36.0, 24.0) / _PHONE_FOCAL_MM)
_PHONE_PITCH, _PHONE_ROLL = math.radians(-4.0), math.radians(1.5)
_PHONE_SPHERE, _PHONE_SIZE, _TURN_SIZE, _TURN_QUALITY = (1536, 3072), (1280, 960), (640, 480), 75
_EXIF_IFD, _FOCAL_LENGTH_35MM = 0x8769, 0xA405


def main() -> None:
    """Render every view of the flat and write the true poses."""
    home = example_home()
    materials = MaterialLibrary.create(np.random.default_rng(_MATERIALS_SEED))
    renderer = SphereRenderer(materials, height=HEIGHT, width=WIDTH, supersample=_SUPERSAMPLE)
    for view in VIEWS:
        (pixels,) = renderer.render([shot_of(home, view)]).numpy()
        Image.fromarray(pixels).save(FOLDER / view.file, quality=_JPEG_QUALITY, optimize=True)
        print(FOLDER / view.file)
    write_poses([true_pose(home.plan, view) for view in VIEWS])
    _write_phone_photographs(home, materials)


def _write_phone_photographs(home: Home, materials: MaterialLibrary) -> None:
    height, width = _PHONE_SPHERE
    (sphere,) = SphereRenderer(materials, height=height, width=width).render([shot_of(home, PHONE)]).numpy()
    exif = Image.Exif()
    exif.get_ifd(_EXIF_IFD)[_FOCAL_LENGTH_35MM] = _PHONE_FOCAL_MM
    for name, turn_deg in {PHONE.file: 0.0, **TURN_DEG}.items():
        size, quality = (_TURN_SIZE, _TURN_QUALITY) if name in TURN_DEG else (_PHONE_SIZE, _JPEG_QUALITY)
        camera = Perspective.of_hfov(*size, _PHONE_HFOV)
        pixels = cut_view(sphere, camera, azimuth=math.radians(turn_deg), pitch=_PHONE_PITCH, roll=_PHONE_ROLL)
        Image.fromarray(pixels).save(FOLDER / name, quality=quality, optimize=True, exif=exif)
        print(FOLDER / name)


def example_home() -> Home:
    """Return the example flat with its doors and windows as the pictures show them."""
    plan = FloorPlan.from_json(PLAN_PATH.read_bytes())
    return Home(plan, tuple(_opening(plan, face) for face in plan.opening_faces))


def _opening(plan: FloorPlan, face: OpeningFace) -> Opening:
    """Return an opening of the plan as seen from one of the rooms beside it."""
    drawn = plan.openings[face.opening]
    x0, y0, x1, y1 = plan.rooms[face.room].walls_m[face.wall]
    length_m = math.hypot(x1 - x0, y1 - y0)
    # The flat states the heights of all openings.
    assert drawn.sill_m is not None
    assert drawn.head_m is not None
    return Opening(
        room=face.room,
        wall=face.wall,
        start_m=face.start * length_m,
        end_m=face.end * length_m,
        sill_m=drawn.sill_m,
        head_m=drawn.head_m,
        kind="door_open" if face.opening in _OPEN_DOORS else _KINDS[drawn.kind],
        neighbour=face.behind,
    )


def shot_of(home: Home, view: View) -> Shot:
    """Return the input of the renderer for a view."""
    position = np.array(view.position_m)
    return Shot(
        home=home,
        position_m=position,
        room_index=int(home.plan.room_index_at(position[None])[0]),
        heading=math.radians(view.heading_deg),
        camera_height_m=view.camera_height_m,
        furniture="full",
        seed=view.seed,
    )


def true_pose(plan: FloorPlan, view: View) -> TruePose:
    x_m, y_m = view.position_m
    room = plan.rooms[int(plan.room_index_at(np.array([view.position_m]))[0])]
    return TruePose(
        file=view.file,
        plan=PLAN_PATH.name,
        room=room.name,
        x_m=x_m,
        y_m=y_m,
        heading_deg=view.heading_deg,
        camera_height_m=view.camera_height_m,
    )


if __name__ == "__main__":
    main()
