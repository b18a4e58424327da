"""A floor plan as a GLB mesh: floor, ceiling and walls of every room.

glTF is y-up: plan point (x, y, z) becomes (x, z, -y), in metres. All faces look into their room, so a viewer that
hides back faces shows the inside from wherever one looks.
"""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from lalaloc_core.floorplan import FloorPlan, Room

_COLOURS = {"floor": (176, 141, 101, 255), "wall": (226, 222, 214, 255), "ceiling": (247, 247, 247, 255)}


def plan_glb(plan: FloorPlan) -> bytes:
    """The plan as binary glTF; one node per surface, named `<number of the room>/<room>/<surface>`."""
    scene = trimesh.Scene()
    for index, room in enumerate(plan.rooms):
        for surface, mesh in _surfaces(room).items():
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
        "floor": _facing(corners, triangles, 0.0, up=True),
        "ceiling": _facing(corners, triangles, height, up=False),
        "wall": _walls(room, height),
    }


def _facing(corners: np.ndarray, triangles: np.ndarray, z: float, *, up: bool) -> trimesh.Trimesh:
    """A horizontal surface whose triangles all look up, or all down."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    looks_up = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] > 0.0
    turned = np.where((looks_up == up)[:, None], triangles, triangles[:, ::-1])
    return _mesh(np.column_stack([corners, np.full(len(corners), z)]), turned)


def _walls(room: Room, height: float) -> trimesh.Trimesh:
    """One rectangle per edge; the polygon runs counter-clockwise, so its left side is the inside."""
    start, end = room.walls_m[:, :2], room.walls_m[:, 2:]
    zero, top = np.zeros(len(start)), np.full(len(start), height)
    vertices = np.stack(
        [
            np.column_stack([start, zero]),
            np.column_stack([end, zero]),
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
