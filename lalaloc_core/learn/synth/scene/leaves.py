"""Leaves of open doors: at any angle, in either room, folded back against the wall, or missing."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import CAMERA_CLEARANCE_M, rectangle, wall_frame
from lalaloc_core.learn.synth.homes.openings import Opening

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
    """Open a door; leaves without space clear of walls and camera, and a random share, are missing.

    `neighbour` is the room behind the opening and `depth_m` the thickness of the wall; leaves keep `CAMERA_CLEARANCE_M`
    away from `camera_m`.
    """
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
