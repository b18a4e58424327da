"""Slow reference renderer of depth, independent of the closed forms.

trimesh and embree (extra `oracle`) cast every pixel's ray against the extruded mesh of the room.
"""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.ray.ray_pyembree import RayMeshIntersector

from lalaloc_core.floorplan import Room


def room_mesh(room: Room) -> trimesh.Trimesh:
    """Return the closed surface of one room: its polygon extruded from the floor (z = 0) to its ceiling, metres."""
    return trimesh.creation.extrude_polygon(room.shape, room.ceiling_height_m)


def reference_depth(
    room: Room, position_m: Float[np.ndarray, "2"], heading: float, camera_height_m: float, rows: int, columns: int
) -> Float[np.ndarray, "{rows} {columns}"]:
    """Return the layout depth (m) of one pose by ray casting; inf for rays that escape through a seam of the mesh."""
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    azimuth = heading + ((j + 0.5) / columns - 0.5) * 2.0 * np.pi
    elevation = (0.5 - (i + 0.5) / rows) * np.pi
    x = np.sin(azimuth) * np.cos(elevation)
    y = np.cos(azimuth) * np.cos(elevation)
    directions = np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)
    origins = np.broadcast_to([*position_m, camera_height_m], directions.shape)
    mesh = room_mesh(room)
    hits, ray, _ = RayMeshIntersector(mesh).intersects_location(origins, directions, multiple_hits=False)
    depth = np.full(rows * columns, np.inf)
    depth[ray] = np.linalg.norm(hits - origins[ray], axis=1)
    return depth.reshape(rows, columns)
