"""Where the name of a room is written: well inside it, found in bounded time whatever its shape."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import Room

# Places looked at: a lattice over the room, then finer ones around the best place so far. The exact answer, the centre
# of the largest inscribed circle, takes seconds for a room of two hundred corners that is wound like a spiral.
_LATTICE, _FINER_LATTICE, _ROUNDS = 20, 7, 2


def label_place(room: Room) -> tuple[float, float, float]:
    """A place (x, y) about as far from the walls as any, and how far that is (m)."""
    shape = room.shape
    shapely.prepare(shape)
    x_min, y_min, x_max, y_max = shape.bounds
    # There is always this one, also in a room that is thinner than the lattice is fine.
    anywhere = np.array([[shape.representative_point().x, shape.representative_point().y]])
    half = np.array([x_max - x_min, y_max - y_min]) / 2.0
    lattice = np.array([(x_min + x_max) / 2.0, (y_min + y_max) / 2.0]) + _cell_centres(_LATTICE) * half
    best, radius_m = _farthest(shape, np.concatenate([anywhere, lattice]))
    half = half / _LATTICE
    for _ in range(_ROUNDS):
        best, radius_m = _farthest(
            shape, np.concatenate([best[None], best + _cell_centres(_FINER_LATTICE) * 2.0 * half])
        )
        half = 2.0 * half / _FINER_LATTICE
    return float(best[0]), float(best[1]), radius_m


def _cell_centres(count: int) -> Float[np.ndarray, "n 2"]:
    """Centres of the cells of a square from -1 to 1 that is cut into `count` x `count`."""
    steps = (2.0 * np.arange(count) + 1.0) / count - 1.0
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _farthest(shape: shapely.Polygon, places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Of some places, the first of which is inside, the one inside that is farthest from the walls, and how far."""
    inside = shapely.contains_xy(shape, places[:, 0], places[:, 1])
    inside[0] = True
    places = places[inside]
    distance_m = np.asarray(shapely.distance(shapely.points(places), shape.boundary))
    chosen = int(distance_m.argmax())
    return places[chosen], float(distance_m[chosen])
