"""Windows with blinds, curtains and radiators."""

from __future__ import annotations

import numpy as np
import shapely

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import CAMERA_CLEARANCE_M, rectangle, wall_frame
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.scene.scene_tables import SceneTables
from lalaloc_core.learn.synth.scene.surfaces import HouseStyle, bright, paint

_HALF_DEPTH_M = 0.05
_CURTAIN_FROM_WALL_M, _RADIATOR_FROM_WALL_M = 0.07, 0.06
_MIN_HALF_WIDTH_M = 0.02


def add_window(tables: SceneTables, style: HouseStyle, wall: int, window: Opening, rng: np.random.Generator) -> None:
    """Add frame, panes and bars of a window, sometimes with a blind or a sheer curtain."""
    s0, s1, z0, z1 = window.start_m, window.end_m, window.sill_m, window.head_m
    border = rng.uniform(0.04, 0.09)
    tables.add_decal(wall, s_m=(s0 - 0.03, s1 + 0.03), z_m=(z0 - 0.03, z1 + 0.03), surface=style.trim)
    # The leaf of a French window has a broad rail at its foot.
    rail = rng.uniform(0.1, 0.35) if z0 < 0.1 and rng.random() < 0.5 else border
    tables.add_decal(wall, s_m=(s0 + border, s1 - border), z_m=(z0 + rail, z1 - border), surface=style.outdoors)
    sashes = max(1, round((s1 - s0) / rng.uniform(0.6, 1.4)))
    for k in range(1, sashes):
        s = s0 + (s1 - s0) * k / sashes
        tables.add_decal(wall, s_m=(s - 0.6 * border, s + 0.6 * border), z_m=(z0, z1), surface=style.trim)
    if rng.random() < 0.2:
        z = rng.uniform(0.4, 0.7) * (z1 - z0) + z0
        tables.add_decal(wall, s_m=(s0, s1), z_m=(z - 0.02, z + 0.02), surface=style.trim)
    if rng.random() < 0.15:
        # A roller blind.
        blind = tables.surfaces.add("furniture", bright(rng), glow=rng.uniform(0.4, 1.2))
        tables.add_decal(wall, s_m=(s0, s1), z_m=(z1 - rng.uniform(0.2, 0.9) * (z1 - z0), z1), surface=blind)
    elif rng.random() < 0.08:
        # A sheer curtain before the whole window.
        sheer = tables.surfaces.add("furniture", bright(rng), scale=rng.uniform(1.0, 3.0), glow=rng.uniform(0.3, 1.0))
        bottom = 0.04 if rng.random() < 0.6 else z0 - 0.05
        tables.add_decal(wall, s_m=(s0 - 0.15, s1 + 0.15), z_m=(bottom, z1 + 0.1), surface=sheer)


def add_curtains(tables: SceneTables, room: Room, window: Opening, rng: np.random.Generator, *, is_bare: bool) -> None:
    """Add curtains on both sides of a window, rarely in a bare home."""
    if rng.random() >= (0.1 if is_bare else 0.45):
        return
    cloth = tables.surfaces.add("furniture", np.clip(paint(rng), 0.03, 0.85), scale=rng.uniform(1.5, 4.0))
    width, top = rng.uniform(0.15, 0.6), min(window.head_m + 0.15, room.ceiling_height_m - 0.01)
    bottom = 0.03 if rng.random() < 0.7 else max(0.03, window.sill_m - 0.1)
    for s in (window.start_m, window.end_m):
        _hang(
            tables,
            room,
            window.wall,
            at_m=s,
            half_m=0.5 * width,
            from_wall_m=_CURTAIN_FROM_WALL_M,
            z_m=(bottom, top),
            surface=cloth,
        )


def add_radiator(tables: SceneTables, style: HouseStyle, room: Room, window: Opening, rng: np.random.Generator) -> None:
    """Add a radiator below some windows."""
    if window.sill_m > 0.45 and rng.random() < 0.35:
        middle, half = 0.5 * (window.start_m + window.end_m), 0.4 * (window.end_m - window.start_m)
        z_m = (0.1, min(0.7, window.sill_m - 0.05))
        _hang(
            tables,
            room,
            window.wall,
            at_m=middle,
            half_m=half,
            from_wall_m=_RADIATOR_FROM_WALL_M,
            z_m=z_m,
            surface=style.trim,
        )


def _hang(
    tables: SceneTables,
    room: Room,
    wall: int,
    *,
    at_m: float,
    half_m: float,
    from_wall_m: float,
    z_m: tuple[float, float],
    surface: int,
) -> None:
    """Add a flat box before a wall, narrower at the wall's end, if it stays in the room and off the camera.

    `at_m` is the position of the box's middle along the wall, `from_wall_m` its distance from the wall, `half_m` half
    its width, and `z_m` its lower and upper end above the floor.
    """
    start, along, inwards = wall_frame(room, wall)
    length = float(np.hypot(*(room.walls_m[wall, 2:] - room.walls_m[wall, :2])))
    half_m = min(half_m, at_m, length - at_m)
    if half_m <= _MIN_HALF_WIDTH_M:
        return
    centre = start + along * at_m + inwards * from_wall_m
    footprint = rectangle(centre, along, half_m, _HALF_DEPTH_M)
    is_clear = shapely.distance(footprint, shapely.Point(tables.camera_m)) > CAMERA_CLEARANCE_M
    if is_clear and room.shape.contains(footprint):
        tables.add_box(centre, along, half_m=(half_m, _HALF_DEPTH_M), z_m=z_m, surface=surface)
