"""Ray tracing against triangles by embree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.learn.heldout.geometry import Part

try:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh
except ImportError as error:  # pragma: no cover
    raise ImportError(
        "heldout homes are traced by embree: install the extra `oracle` (embreex), as `make develop` does"
    ) from error

# Rays start this far (m) from their surface, so that they do not hit it.
OFFSET_M = 1e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of rays; `face` is -1 and `distance_m` inf for a miss."""

    face: Int[np.ndarray, "n"]
    distance_m: Float[np.ndarray, "n"]
    u: Float[np.ndarray, "n"]
    v: Float[np.ndarray, "n"]


class Tracer:
    """Parts of a home as one mesh.

    `surface` (an index into `surfaces`) and `room` are per face, `corner_normals` per face and corner.
    """

    def __init__(self, parts: list[tuple[int, Part]]) -> None:
        names = sorted({part.surface for _, part in parts})
        numbers = {name: k for k, name in enumerate(names)}
        offsets = np.cumsum([0] + [len(part.vertices_m) for _, part in parts[:-1]])
        vertices = np.concatenate([part.vertices_m for _, part in parts]).astype(np.float32)
        faces = np.concatenate([part.faces + k for (_, part), k in zip(parts, offsets, strict=True)]).astype(np.int32)
        counts = [len(part.faces) for _, part in parts]
        self.surfaces = tuple(names)
        self.surface = np.repeat([numbers[part.surface] for _, part in parts], counts)
        self.room = np.repeat([room for room, _ in parts], counts)
        self.corner_normals = np.concatenate([part.corner_normals() for _, part in parts]).astype(np.float32)
        self._scene = rtcore_scene.EmbreeScene(robust=True)  # pyright: ignore[reportAttributeAccessIssue]
        self._mesh = TriangleMesh(self._scene, vertices, faces)

    def first(self, origin_m: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]) -> Hits:
        """Return the first hit of each ray."""
        found = self._scene.run(_single(origin_m), _single(direction), output=True)
        missed = found["primID"] < 0
        distance = np.where(missed, np.float32(np.inf), found["tfar"])
        return Hits(found["primID"], distance, found["u"], found["v"])

    def blocked(
        self, origin_m: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"], within_m: Float[np.ndarray, "n"]
    ) -> Bool[np.ndarray, "n"]:
        """Return for each ray if an obstacle is nearer than `within_m`."""
        reach = np.ascontiguousarray(within_m, dtype=np.float32)
        return self._scene.run(_single(origin_m), _single(direction), reach, query="OCCLUDED") != -1

    def normals(self, hits: Hits, direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return unit normals of the hits on the incoming side; for misses, against the ray."""
        corners = self.corner_normals[hits.face]
        u, v = hits.u[:, None], hits.v[:, None]
        normal = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
        normal = np.where(hits.face[:, None] < 0, -direction, normal)
        normal /= np.sqrt(np.einsum("nk,nk->n", normal, normal))[:, None] + 1e-9
        away = np.einsum("nk,nk->n", normal, direction) > 0.0
        return np.where(away[:, None], -normal, normal)


def _single(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)
