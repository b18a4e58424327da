"""GLB mesh of a floor plan: floor, ceiling and walls of every room, and panels for openings.

glTF is y-up: the plan point (x, y, z) becomes (x, z, -y), in metres. All faces point into their room, so a viewer that
culls back faces shows the inside from any direction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from lalaloc_core.floorplan import USUAL_HEIGHTS_M, FloorPlan, OpeningFace, Room

_COLOURS = {
    "floor": (176, 141, 101, 255),
    "wall": (226, 222, 214, 255),
    "ceiling": (247, 247, 247, 255),
    "door": (150, 98, 54, 255),
    "window": (150, 200, 235, 255),
    "passage": (90, 90, 95, 255),
}
# Distance between the panels of openings and their wall.
_PANEL_OFFSET_M = 0.005


def plan_glb(plan: FloorPlan) -> bytes:
    """Return the plan as binary glTF with one node per surface, named `<room number>/<room>/<surface>`."""
    scene = trimesh.Scene()
    for index, room in enumerate(plan.rooms):
        for surface, mesh in (_surfaces(room) | _openings(plan, room, plan.room_faces[index])).items():
            material = PBRMaterial(
                name=surface, baseColorFactor=_COLOURS[surface], metallicFactor=0.0, roughnessFactor=0.9
            )
            mesh.visual = TextureVisuals(material=material)
            name = f"{index + 1}/{room.name}/{surface}"
            scene.add_geometry(mesh, node_name=name, geom_name=name)
    return export_glb(scene)


def _surfaces(room: Room) -> dict[str, trimesh.Trimesh]:
    corners, triangles = trimesh.creation.triangulate_polygon(room.shape, engine="earcut")
    height = room.ceiling_height_m
    return {
        "floor": _horizontal(corners, triangles, 0.0, up=True),
        "ceiling": _horizontal(corners, triangles, height, up=False),
        "wall": _walls(room, height),
    }


def _openings(plan: FloorPlan, room: Room, faces: Sequence[OpeningFace]) -> dict[str, trimesh.Trimesh]:
    """Return panels on the walls of a room, one mesh per kind of opening."""
    panels: dict[str, list[np.ndarray]] = {}
    for face in faces:
        opening = plan.openings[face.opening]
        low, high = USUAL_HEIGHTS_M[opening.kind]
        low = low if opening.sill_m is None else opening.sill_m
        high = min(high if opening.head_m is None else opening.head_m, room.ceiling_height_m)
        ends = room.walls_m[face.wall].reshape(2, 2)
        edge = ends[1] - ends[0]
        inwards = np.array([-edge[1], edge[0]]) / np.hypot(*edge)
        start, end = ends[0] + np.array([[face.start], [face.end]]) * edge + _PANEL_OFFSET_M * inwards
        if low < high:
            panels.setdefault(opening.kind, []).append(np.array([[*start, *end, low, high]]))
    joined = {kind: np.concatenate(rows) for kind, rows in panels.items()}
    return {kind: _vertical(rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5]) for kind, rows in joined.items()}


def _horizontal(corners: np.ndarray, triangles: np.ndarray, z: float, *, up: bool) -> trimesh.Trimesh:
    """Return a horizontal surface whose triangles all face up, or all down."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    faces_up = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] > 0.0
    turned = np.where((faces_up == up)[:, None], triangles, triangles[:, ::-1])
    return _mesh(np.column_stack([corners, np.full(len(corners), z)]), turned)


def _walls(room: Room, height: float) -> trimesh.Trimesh:
    """Return one rectangle per edge, with the room to its left; free-standing walls have one per side."""
    walls = np.concatenate([room.walls_m, room.inner_walls_m[:, [2, 3, 0, 1]]])
    return _vertical(walls[:, :2], walls[:, 2:], np.zeros(len(walls)), np.full(len(walls), height))


def _vertical(start: np.ndarray, end: np.ndarray, bottom: np.ndarray, top: np.ndarray) -> trimesh.Trimesh:
    """Return rectangles between two heights that face the left of start to end."""
    vertices = np.stack(
        [
            np.column_stack([start, bottom]),
            np.column_stack([end, bottom]),
            np.column_stack([end, top]),
            np.column_stack([start, top]),
        ],
        axis=1,
    ).reshape(-1, 3)
    first = 4 * np.arange(len(start))[:, None, None]
    return _mesh(vertices, (first + np.array([[0, 2, 1], [0, 3, 2]])).reshape(-1, 3))


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    y_up = vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    return trimesh.Trimesh(y_up, faces, process=False)
