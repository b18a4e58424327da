"""Floor of a solid: level, stepped or sloped."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.common.geometry import polygons_from_geometry
from lalaloc_core.importers.common.import_report import ReportBuilder

# Faces steeper than 45° are walls: the vertical part of their normal is smaller.
_FLAT = 0.7
# Faces up to this height above the lowest are floor, and so are their neighbours up to a high step (m). The faces of
# one step touch within the rounding of the file.
_LEVEL_M, STEP_M, _TOUCHING_M = 0.05, 0.6, 0.01
# A face over this share of faces that are floor is a ceiling.
_OVER = 0.5
# Rounding gaps between faces that are closed.
_SEAM_M = 1e-4
# Rise of a floor (m), and share of a room that is higher than its floor, that are reported.
_UNEVEN_M, _MIN_HIGHER = 0.1, 0.02


@dataclass(frozen=True, eq=False)
class Floor:
    """Floor of a solid.

    Attributes:
        parts: its outlines.
        low_m: height of its lowest point.
        rise_m: height of its highest point above the lowest.
        higher_m2: area of the solid that lies beside its floor, more than a step above it.
    """

    parts: list[shapely.Polygon]
    low_m: float
    rise_m: float
    higher_m2: float


def find_floor(faces: Iterable[Float[np.ndarray, "_ 3"]], check_time: Callable[[], None]) -> Floor | None:
    """Return the floor among the faces of a solid, or of a surface, in metres; None if all faces are steep.

    The floor begins with the lowest face and grows over faces that touch it, up to a step of 60 cm each. `check_time`
    raises an exception to stop.
    """
    flat = [(shape, face[:, 2]) for face in faces if (shape := _seen_from_above(face)) is not None]
    if not flat:
        return None
    shapes = [shape for shape, _ in flat]
    lows = np.array([heights.min() for _, heights in flat])
    highs = np.array([heights.max() for _, heights in flat])
    tree = shapely.STRtree(shapes)
    found = np.zeros(len(flat), bool)
    queue = [(float(lows[index]), int(index)) for index in np.flatnonzero(lows <= lows.min() + _LEVEL_M)]
    heapq.heapify(queue)
    queued = {index for _, index in queue}
    while queue:
        check_time()
        _, index = heapq.heappop(queue)
        near = tree.query(shapes[index], predicate="dwithin", distance=_TOUCHING_M)
        below = near[found[near]]
        covered = shapely.area(shapely.intersection(shapes[index], [shapes[k] for k in below])).sum()
        if covered > _OVER * shapes[index].area:
            continue
        found[index] = True
        for other in near:
            step = max(lows[index], lows[other]) - min(highs[index], highs[other])
            if step <= STEP_M and int(other) not in queued:
                queued.add(int(other))
                heapq.heappush(queue, (float(lows[other]), int(other)))
    floor = join_faces([shape for shape, is_floor in zip(shapes, found, strict=True) if is_floor])
    whole = join_faces(shapes)
    return Floor(
        floor,
        float(lows.min()),
        float(highs[found].max() - lows.min()),
        sum(part.area for part in whole) - sum(part.area for part in floor),
    )


def report_floor(name: str, floor: Floor, builder: ReportBuilder) -> None:
    """Report a floor that is not level, and parts of a room that are higher than its floor."""
    if floor.rise_m > _UNEVEN_M:
        builder.notes.append(
            f"the floor of {name} rises by {floor.rise_m:.2f} m; heights in it count from its lowest point"
        )
    whole_m2 = floor.higher_m2 + sum(part.area for part in floor.parts)
    if floor.higher_m2 > _MIN_HIGHER * whole_m2:
        builder.warnings.append(
            f"{floor.higher_m2:.1f} m² of {name} ({100.0 * floor.higher_m2 / whole_m2:.0f} %) lie more than "
            f"{STEP_M:g} m above its floor and were left out; make it two spaces if they are floor"
        )


def join_faces(shapes: list[shapely.Polygon]) -> list[shapely.Polygon]:
    """Return the area that faces cover, without the gaps that rounding leaves between them."""
    union = shapely.unary_union([shape.buffer(_SEAM_M, join_style="mitre") for shape in shapes])
    return polygons_from_geometry(union.buffer(-_SEAM_M, join_style="mitre"))


def _seen_from_above(face: Float[np.ndarray, "n 3"]) -> shapely.Polygon | None:
    """Return the outline of a face, None if it is steep or has no area."""
    if len(face) < 3:
        return None
    # Newell's method: the normal of a polygon that need not be plane.
    local = face - face[0]
    normal = 0.5 * np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    size = float(np.linalg.norm(normal))
    if size < 1e-9 or abs(normal[2]) < _FLAT * size:
        return None
    parts = polygons_from_geometry(shapely.Polygon(face[:, :2]))
    return max(parts, key=lambda part: part.area, default=None)
