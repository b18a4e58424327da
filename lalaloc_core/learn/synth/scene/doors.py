"""Doors and wide openings: frames, the holes into the next room, and leaves.

Leaves of open doors stand at any angle, in either room, folded back against the wall, or are missing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import CAMERA_CLEARANCE_M, rectangle, wall_frame
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.homes.plans import Home
from lalaloc_core.learn.synth.scene.render_scene import SceneTables
from lalaloc_core.learn.synth.scene.surfaces import HouseStyle

# Wider doors have two leaves.
DOUBLE_FROM_M = 1.15
_HALF_THICKNESS_M = 0.018
_HINGE_GAP_M = 0.03
_STILE_M = 0.055

# Shares and angles (degrees) of leaves that are ajar, at about a right angle, and flat against the wall.
_ANGLES_DEG = ((15.0, 55.0), (55.0, 120.0), (120.0, 168.0), (168.0, 177.0))
_ANGLE_SHARES = (0.15, 0.4, 0.15, 0.3)


class Leaf(NamedTuple):
    """A leaf of an open door in the plan frame; `axis` points from the hinge to the handle."""

    centre_m: Float[np.ndarray, "2"]
    axis: Float[np.ndarray, "2"]
    half_width_m: float
    in_own_room: bool


class Board(NamedTuple):
    """A vertical box of a leaf: offset along the leaf's axis, half length, half thickness, and z-range, metres."""

    along_m: float
    half_a: float
    half_b: float
    z0: float
    z1: float


def hang_leaves(
    opening: Opening,
    room: Room,
    neighbour: Room,
    depth_m: float,
    camera_m: Float[np.ndarray, "2"],
    rng: np.random.Generator,
) -> list[Leaf]:
    """Open a door; leaves without space clear of walls and camera, and a random share, are missing."""
    if rng.random() < 0.15:
        return []
    start, along, inwards = wall_frame(room, opening.wall)
    width = opening.end_m - opening.start_m
    is_double = width > DOUBLE_FROM_M
    if is_double:
        width *= 0.5
    sides = (True, False) if rng.random() < 0.6 else (False, True)
    hinges = (True, False) if rng.random() < 0.5 else (False, True)
    leaves: list[Leaf] = []
    for into_own in sides:
        for at_start in hinges:
            low, high = _ANGLES_DEG[int(rng.choice(len(_ANGLES_DEG), p=_ANGLE_SHARES))]
            angle = math.radians(rng.uniform(low, high))
            outward = inwards if into_own else -inwards
            hinge = start + along * (opening.start_m if at_start else opening.end_m)
            hinge = hinge if into_own else hinge - inwards * depth_m
            axis = (along if at_start else -along) * math.cos(angle) + outward * math.sin(angle)
            centre = hinge + axis * 0.5 * width + outward * _HINGE_GAP_M
            footprint = rectangle(centre, axis, 0.49 * width, _HALF_THICKNESS_M)
            target = room if into_own else neighbour
            clear = shapely.distance(footprint, shapely.Point(camera_m)) > CAMERA_CLEARANCE_M
            if clear and target.shape.contains(footprint):
                leaves.append(Leaf(centre, axis, 0.49 * width, into_own))
                if not is_double:
                    return leaves
        if leaves:
            return leaves
    return leaves


def boards(half_width_m: float, head_m: float, *, glazed: bool) -> list[Board]:
    """Return the wood of a leaf: one board, or the frame around a transparent pane."""
    bottom, top = 0.01, head_m - 0.01
    if not glazed:
        return [Board(0.0, half_width_m, _HALF_THICKNESS_M, bottom, top)]
    side = half_width_m - _STILE_M
    return [
        Board(-side, _STILE_M, _HALF_THICKNESS_M, bottom, top),
        Board(side, _STILE_M, _HALF_THICKNESS_M, bottom, top),
        Board(0.0, side, 0.8 * _HALF_THICKNESS_M, bottom, 0.2),
        Board(0.0, side, 0.8 * _HALF_THICKNESS_M, top - 0.12, top),
    ]


# Implausible wall thicknesses between two rooms are replaced by the usual one.
_USUAL_DEPTH_M, _MAX_DEPTH_M = 0.12, 0.6
# Leaves and holes begin below the floor: no crack is seen.
_BELOW_M = -1.0
_HANDLE_M = 1.0


def add_door(
    tables: SceneTables,
    style: HouseStyle,
    home: Home,
    opening: Opening,
    *,
    wall: int,
    slot_behind: int | None,
    rng: np.random.Generator,
) -> None:
    """Add a door or a wide opening; `slot_behind` is the slot of the room behind it, None if it is closed or dark."""
    room = home.plan.rooms[opening.room]
    s0, s1, head = opening.start_m, opening.end_m, opening.head_m
    is_framed = opening.kind != "opening" or (head < room.ceiling_height_m - 0.15 and rng.random() < 0.3)
    if is_framed:
        border = rng.uniform(0.04, 0.1)
        tables.add_decal(wall, s_m=(s0 - border, s1 + border), z_m=(0.0, head + border), surface=style.trim)
    if slot_behind is not None:
        neighbour = home.plan.rooms[opening.neighbour]
        depth = _hole_depth(room, neighbour, opening)
        cheeks = style.trim if is_framed else tables.wall_surfaces[wall]
        tables.add_decal(wall, s_m=(s0, s1), z_m=(_BELOW_M, head), surface=cheeks, slot=slot_behind, depth_m=depth)
        _add_threshold(tables, style, room, opening, depth, rng)
        if opening.kind == "door_open":
            for leaf in hang_leaves(opening, room, neighbour, depth, tables.camera_m, rng):
                _add_leaf(tables, style, leaf, head)
    elif opening.kind == "door_shut" or (opening.kind == "door_open" and rng.random() < 0.5):
        _add_shut_door(tables, style, wall, opening, rng)
    else:
        tables.add_decal(wall, s_m=(s0, s1), z_m=(_BELOW_M, head), surface=style.gloom)


def _hole_depth(room: Room, neighbour: Room, opening: Opening) -> float:
    middle, _, inwards = _frame_of(room, opening)
    ray = shapely.LineString([middle, middle - inwards])
    depth = float(shapely.distance(shapely.Point(middle), shapely.intersection(ray, neighbour.shape)))
    return depth if 0.0 < depth < _MAX_DEPTH_M else _USUAL_DEPTH_M


def _frame_of(
    room: Room, opening: Opening
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    start, along, inwards = wall_frame(room, opening.wall)
    return start + along * 0.5 * (opening.start_m + opening.end_m), along, inwards


def _add_shut_door(
    tables: SceneTables, style: HouseStyle, wall: int, opening: Opening, rng: np.random.Generator
) -> None:
    s0, s1, head = opening.start_m, opening.end_m, opening.head_m
    middle, is_double = 0.5 * (s0 + s1), s1 - s0 > DOUBLE_FROM_M
    tables.add_decal(wall, s_m=(s0, s1), z_m=(_BELOW_M, head), surface=style.door)
    panels = int(rng.integers(0, 4))
    panel = style.gloom if style.doors_are_glazed else style.door_panel
    for start, end in [(s0, middle), (middle, s1)] if is_double else [(s0, s1)]:
        for k in range(panels):
            low, high = 0.15 + k * (head - 0.25) / panels, 0.05 + (k + 1) * (head - 0.25) / panels
            tables.add_decal(wall, s_m=(start + 0.12, end - 0.12), z_m=(low, high), surface=panel)
    s = middle - 0.08 if is_double else (s1 - 0.08 if rng.random() < 0.5 else s0 + 0.08)
    tables.add_decal(wall, s_m=(s - 0.05, s + 0.05), z_m=(_HANDLE_M, _HANDLE_M + 0.04), surface=style.handle)
    if is_double:
        tables.add_decal(wall, s_m=(middle - 0.006, middle + 0.006), z_m=(0.0, head), surface=style.gloom)


def _add_leaf(tables: SceneTables, style: HouseStyle, leaf: Leaf, head_m: float) -> None:
    for board in boards(leaf.half_width_m, head_m, glazed=style.doors_are_glazed):
        centre = leaf.centre_m + leaf.axis * board.along_m
        half_m, z_m = (board.half_a, board.half_b), (board.z0, board.z1)
        tables.add_box(centre, leaf.axis, half_m=half_m, z_m=z_m, surface=style.door)
    knob = leaf.centre_m + leaf.axis * 0.8 * leaf.half_width_m
    tables.add_box(knob, leaf.axis, half_m=(0.06, 0.06), z_m=(_HANDLE_M, _HANDLE_M + 0.03), surface=style.handle)


def _add_threshold(
    tables: SceneTables, style: HouseStyle, room: Room, opening: Opening, depth_m: float, rng: np.random.Generator
) -> None:
    if rng.random() > 0.2:
        return
    middle, along, inwards = _frame_of(room, opening)
    surface = style.trim if rng.random() < 0.5 else style.handle
    half = 0.5 * (opening.end_m - opening.start_m)
    centre = middle - inwards * 0.5 * depth_m
    tables.add_box(centre, along, half_m=(half, 0.5 * depth_m), z_m=(0.0, rng.uniform(0.006, 0.025)), surface=surface)
