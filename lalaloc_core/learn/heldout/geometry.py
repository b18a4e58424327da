"""Triangle meshes of turned, extruded, bent and inflated shapes, and their union for the tracer.

Every part has the name of its surface; the home chooses the material of each surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import shapely
import trimesh
from jaxtyping import Float, Int
from shapely.geometry.base import BaseGeometry

# Lengths and angles can be integers.
Number = float | int


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh with one surface.

    `surface` is a kind of surface, such as `floor`, which selects the material. Light sees the vertices' normals of
    `smooth` meshes, otherwise the facets'.
    """

    surface: str
    vertices_m: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    smooth: bool = False

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> Part:
        """Return the part with its vertices mapped by a function."""
        return replace(self, vertices_m=function(self.vertices_m))

    def moved(self, x_m: Number = 0.0, y_m: Number = 0.0, z_m: Number = 0.0) -> Part:
        """Return the part translated."""
        return self.mapped(lambda v: v + np.array([x_m, y_m, z_m]))

    def turned(self, angle: Number, axis: int = 2) -> Part:
        """Return the part turned about an axis through the origin, counter-clockwise by radians."""
        a, b = (axis + 1) % 3, (axis + 2) % 3
        rotation = np.eye(3)
        rotation[[a, a, b, b], [a, b, a, b]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        return self.mapped(lambda v: v @ rotation.T)

    def scaled(self, x: Number, y: Number, z: Number) -> Part:
        """Return the part stretched about the origin."""
        return self.mapped(lambda v: v * np.array([x, y, z]))

    def corner_normals(self) -> Float[np.ndarray, "m 3 3"]:
        """Return the unit normal at each corner of each face; upward for faces without area."""
        corners = self.vertices_m[self.faces]
        crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if not self.smooth:
            return np.repeat(_unit(crossed)[:, None], 3, axis=1)
        summed = np.zeros_like(self.vertices_m)
        for k in range(3):
            np.add.at(summed, self.faces[:, k], crossed)
        return _unit(summed)[self.faces]


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), np.array([0.0, 0.0, 1.0]))


def triangles_of(polygon: shapely.Polygon) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, "m 3"]]:
    """Triangulate a polygon, with or without holes."""
    vertices, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
    return np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def slab(surface: str, shape: BaseGeometry, low_m: Number, high_m: Number) -> Part:
    """Extrude a footprint, one polygon, from one height to another."""
    assert isinstance(shape, shapely.Polygon)
    flat, cap = triangles_of(shape)
    low, high = (np.concatenate([flat, np.full((len(flat), 1), z)], axis=1) for z in (low_m, high_m))
    vertices, faces = [low, high], [cap[:, ::-1], cap + len(flat)]
    count = 2 * len(flat)
    for ring in (shape.exterior, *shape.interiors):
        corners = np.array(ring.coords)[:-1]
        n = len(corners)
        vertices += [np.concatenate([corners, np.full((n, 1), z)], axis=1) for z in (low_m, high_m)]
        a = np.arange(n) + count
        b = np.roll(a, -1)
        faces += [np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)]
        count += 2 * n
    return Part(surface, np.concatenate(vertices), np.concatenate(faces))


def section(surface: str, shape: BaseGeometry, left_m: Number, right_m: Number) -> Part:
    """Extrude a shape of the (y, z) plane along x, such as the section of a sofa."""
    part = slab(surface, shape, left_m, right_m)
    return part.mapped(lambda v: v[:, [2, 0, 1]])


def lathe(surface: str, outline_m: Sequence[tuple[Number, Number]], sides: int = 18) -> Part:
    """Return a solid of revolution about z from (radius, height) points, from bottom to top; radius 0 closes it."""
    profile = np.array(outline_m, dtype=np.float64)
    angle = np.arange(sides) / sides * 2 * np.pi
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [profile[:, None, :1] * ring[None], np.repeat(profile[:, None, 1:], sides, axis=1)], axis=2
    ).reshape(-1, 3)
    level, side = np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij")
    a, b = level * sides + side, level * sides + (side + 1) % sides
    faces = np.concatenate([np.stack([a, b, b + sides], -1), np.stack([a, b + sides, a + sides], -1)]).reshape(-1, 3)
    return Part(surface, vertices, faces, smooth=True)


def tube(surface: str, start_m: Sequence[Number], end_m: Sequence[Number], radius_m: Number, sides: int = 8) -> Part:
    """Return a round bar with round ends."""
    start, end = np.array(start_m, dtype=np.float64), np.array(end_m, dtype=np.float64)
    length = float(np.linalg.norm(end - start))
    bend = [(radius_m * np.cos(a), radius_m * np.sin(a)) for a in np.radians([0, 50, 90])]
    outline = [(r, -h) for r, h in reversed(bend)] + [(r, length + h) for r, h in bend]
    matrix = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], (end - start) / length))[:3, :3]
    return lathe(surface, outline, sides).mapped(lambda v: v @ matrix.T + start)


def blob(surface: str, radii_m: Sequence[Number], detail: int = 2) -> Part:
    """Return an ellipsoid about the origin."""
    vertices, faces = _sphere(detail)
    return Part(surface, vertices, faces, smooth=True).scaled(*radii_m)


@cache
def _sphere(detail: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    mesh = trimesh.creation.icosphere(subdivisions=detail)
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)


def crumpled(part: Part, depth: Number, rng: np.random.Generator) -> Part:
    """Return the part with soft dents and bulges up to `depth` of its size, for cushions and bushes."""
    waves = rng.normal(size=(6, 3)) * 4.0
    phase = rng.uniform(0, 6, 6)

    def dent(v: np.ndarray) -> np.ndarray:
        size = np.abs(v).max() + 1e-9
        return v * (1 + depth * np.sin(v / size @ waves.T + phase).mean(axis=1, keepdims=True) * 2)

    return part.mapped(dent)


def folded_sheet(
    surface: str, *, width_m: Number, low_m: Number, high_m: Number, folds: Number, depth_m: Number
) -> Part:
    """Return a hanging cloth along x with sinusoidal folds."""
    columns = max(int(folds * 10), 4)
    x = np.linspace(0.0, width_m, columns + 1)
    y = depth_m * np.sin(x / width_m * folds * 2 * np.pi)
    bottom = np.stack([x, y * 1.2, np.full_like(x, low_m)], axis=1)
    top = np.stack([x, y * 0.7, np.full_like(x, high_m)], axis=1)
    a = np.arange(columns)
    b = a + columns + 1
    faces = np.concatenate([np.stack([a, a + 1, b + 1], 1), np.stack([a, b + 1, b], 1)])
    return Part(surface, np.concatenate([bottom, top]), faces, smooth=True)


def rounded(width_m: Number, depth_m: Number, radius_m: Number, segments: int = 3) -> shapely.Polygon:
    """Return a footprint with round corners: x from -width/2 to width/2, y from 0 to depth."""
    r = min(radius_m, 0.49 * width_m, 0.49 * depth_m)
    core = shapely.box(-width_m / 2 + r, r, width_m / 2 - r, depth_m - r)
    return core.buffer(r, quad_segs=segments)


def disc(radius_m: Number, segments: int = 6) -> shapely.Polygon:
    """Return a round footprint about the origin."""
    return shapely.Point(0.0, 0.0).buffer(radius_m, quad_segs=segments)
