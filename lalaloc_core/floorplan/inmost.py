"""A place well inside a room, found in bounded time whatever the room's shape."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

# Places looked at: a lattice over the floor, then finer ones around the best place so far. The exact answer, the centre
# of the largest inscribed circle, takes seconds for a floor of two hundred corners that is wound like a spiral.
_LATTICE, _FINER_LATTICE, _ROUNDS = 20, 7, 5


def inmost_place(floor: BaseGeometry) -> tuple[Float[np.ndarray, "2"], float]:
    """A place about as far from the edges of a floor as any on it, and how far that is (m).

    For a room that people live in it is the centre of the largest circle in it, to a centimetre; of several that are as
    large, and in a floor narrower than a twentieth of its extent, it is one of many that would do.

    Args:
        floor: one polygon or several, not empty.
    """
    shapely.prepare(floor)
    x_min, y_min, x_max, y_max = floor.bounds
    middle, half = np.array([x_min + x_max, y_min + y_max]) / 2.0, np.array([x_max - x_min, y_max - y_min]) / 2.0
    # There is always this one, also where the floor is thinner than the lattice is fine.
    anywhere = floor.representative_point()
    best, distance_m = _farthest(floor, np.array([[anywhere.x, anywhere.y]]), middle + half * _cell_centres(_LATTICE))
    half = half / _LATTICE
    for _ in range(_ROUNDS):
        # Twice as wide as the cell that the best place stands for: a better one may lie beyond its edge.
        half = 2.0 * half
        best, distance_m = _farthest(floor, best[None], best + half * _cell_centres(_FINER_LATTICE))
        half = half / _FINER_LATTICE
    return best, distance_m


def _cell_centres(count: int) -> Float[np.ndarray, "n 2"]:
    """Centres of the cells of a square from -1 to 1 that is cut into `count` x `count`."""
    steps = (2.0 * np.arange(count) + 1.0) / count - 1.0
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _farthest(
    floor: BaseGeometry, inside: Float[np.ndarray, "1 2"], places: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Of a place that is on the floor and some that may be, the one on it that is farthest from its edges; how far."""
    places = np.concatenate([inside, places[shapely.contains_xy(floor, places[:, 0], places[:, 1])]])
    distance_m = np.asarray(shapely.distance(shapely.points(places), floor.boundary))
    chosen = int(distance_m.argmax())
    return places[chosen], float(distance_m[chosen])
