"""The extruded mesh of a plan: what the closed form replaces, kept for export and as the oracle's scene."""

from __future__ import annotations

import trimesh

from lalaloc_core.floorplan import FloorPlan, Room


def room_mesh(room: Room) -> trimesh.Trimesh:
    """The closed surface of one room: its polygon extruded from the floor (z = 0) to its ceiling, metres."""
    return trimesh.creation.extrude_polygon(room.shape, room.ceiling_height_m)


def plan_scene(plan: FloorPlan) -> trimesh.Scene:
    """All rooms of a plan as one scene, a named geometry each, z up."""
    scene = trimesh.Scene()
    for index, room in enumerate(plan.rooms):
        scene.add_geometry(room_mesh(room), geom_name=f"{index} {room.name}", node_name=f"{index} {room.name}")
    return scene
