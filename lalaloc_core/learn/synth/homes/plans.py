"""Procedural homes: a floor plan, and the doors and windows that its photographs need.

Home number i of a split is drawn by `default_rng([split, seed, i])`. Training homes are `VARIED_HOMES`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.synth.homes.openings import Opening, place_openings
from lalaloc_core.learn.synth.homes.partition import Cell, inner_outline, partition, reshape_room, with_wing_wall

# Plans do not say which doors are open.
_PLAN_KINDS = {"door_open": "door", "door_shut": "door", "opening": "passage", "window": "window"}


@dataclass(frozen=True, kw_only=True)
class HomeConfig:
    """Ranges (low, high) and shares that homes are drawn from; lengths in metres."""

    rooms: tuple[int, int] = (3, 10)
    area_m2: tuple[float, float] = (30.0, 180.0)
    area_per_room_m2: tuple[float, float] = (8.0, 28.0)
    wall_thickness_m: tuple[float, float] = (0.08, 0.25)
    corridor_width_m: tuple[float, float] = (1.0, 1.9)
    ceiling_height_m: tuple[float, float] = (2.2, 3.5)
    # Open-plan homes: few rooms, large ones.
    open_plan_share: float = 0.15
    open_plan_rooms: tuple[int, int] = (3, 5)
    open_plan_area_per_room_m2: tuple[float, float] = (25.0, 42.0)
    # Share of homes that are turned in the plan frame, that have no right angles, whose ceilings differ.
    rotated_share: float = 0.3
    sheared_share: float = 0.1
    mixed_ceilings_share: float = 0.25
    # Share of rooms with a wall that ends in the middle of the room.
    wing_wall_share: float = 0.0
    # Share of windows that reach down to the floor.
    french_window_share: float = 0.25
    offset_m: float = 10.0


# Training homes are more varied than test homes, like real ones: high rooms, walls that end in the middle of a room,
# open plans, windows that resemble doors.
VARIED_HOMES = HomeConfig(
    ceiling_height_m=(2.1, 4.8), wing_wall_share=0.2, open_plan_share=0.2, french_window_share=0.4
)


@dataclass(frozen=True, eq=False)
class Home:
    """A floor plan, with the openings in its walls as seen from each room; the plan contains them too."""

    plan: FloorPlan
    openings: tuple[Opening, ...]


def generate_home(rng: np.random.Generator, config: HomeConfig = HomeConfig()) -> Home:
    """Draw a home: rooms lie one wall thickness apart, and openings are consistent between the two rooms they join."""
    is_open_plan = rng.random() < config.open_plan_share
    between = config.open_plan_rooms if is_open_plan else config.rooms
    rooms = int(rng.integers(between[0], between[1] + 1))
    per_room = config.open_plan_area_per_room_m2 if is_open_plan else config.area_per_room_m2
    area = float(np.clip(rooms * rng.uniform(*per_room), *config.area_m2))
    cells = partition(rng, rooms, area, config.corridor_width_m)[: config.rooms[1]]
    if rng.random() < config.sheared_share:
        shear = np.array([[1.0, rng.uniform(-0.25, 0.25)], [0.0, 1.0]])
        cells = [Cell(cell.outline_m @ shear.T, cell.corridor) for cell in cells]
    thickness = rng.uniform(*config.wall_thickness_m)
    polygons = []
    for cell in cells:
        polygon = inner_outline(cell.outline_m, 0.5 * thickness)
        changes = 0 if rng.random() < 0.4 else int(rng.integers(1, 4))
        polygon = reshape_room(polygon, rng, changes)
        if config.wing_wall_share and rng.random() < config.wing_wall_share:
            polygon = with_wing_wall(polygon, rng)
        polygons.append(polygon)
    names = _name_rooms([_area(polygon) for polygon in polygons], [cell.corridor for cell in cells], rng)
    ceilings = _ceilings(names, config, rng)
    openings = place_openings(
        names,
        polygons,
        ceilings,
        [cell.outline_m for cell in cells],
        max_gap_m=thickness + 0.01,
        rng=rng,
        french_window_share=config.french_window_share,
    )
    plan = _plan(names, _place_in_frame(polygons, config, rng), ceilings, openings)
    return Home(plan, openings)


def _area(polygon_m: Float[np.ndarray, "n 2"]) -> float:
    x, y = polygon_m.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _name_rooms(areas_m2: Sequence[float], corridors: Sequence[bool], rng: np.random.Generator) -> list[str]:
    """Return kinds of rooms by size, numbered where one repeats: "bedroom 1"."""
    kinds = [""] * len(areas_m2)
    has_kitchen = False
    for rank, index in enumerate(np.argsort(areas_m2)[::-1]):
        area = areas_m2[index]
        if corridors[index]:
            kinds[index] = "corridor"
        elif area < 2.8:
            kinds[index] = str(rng.choice(["closet", "storage", "bathroom"]))
        elif area < 6.0:
            kinds[index] = str(rng.choice(["bathroom", "bathroom", "storage", "kitchen"]))
        elif rank == 0 or area > 30.0:
            kinds[index] = "living room"
        elif not has_kitchen:
            kinds[index] = "kitchen"
        else:
            kinds[index] = str(rng.choice(["bedroom", "bedroom", "bedroom", "study", "dining room"]))
        has_kitchen |= kinds[index] == "kitchen"
    total, seen = Counter(kinds), Counter[str]()
    names = []
    for kind in kinds:
        seen[kind] += 1
        names.append(f"{kind} {seen[kind]}" if total[kind] > 1 else kind)
    return names


def _ceilings(names: Sequence[str], config: HomeConfig, rng: np.random.Generator) -> list[float]:
    low, high = config.ceiling_height_m
    usual = float(np.clip(rng.normal(2.6, 0.2), low, high)) if rng.random() < 0.75 else float(rng.uniform(low, high))
    if rng.random() >= config.mixed_ceilings_share:
        return [usual] * len(names)
    lowered = float(rng.uniform(low, usual))
    return [
        lowered if name.startswith(("bathroom", "corridor", "closet")) or rng.random() < 0.15 else usual
        for name in names
    ]


def _place_in_frame(
    polygons_m: Sequence[Float[np.ndarray, "_ 2"]], config: HomeConfig, rng: np.random.Generator
) -> list[Float[np.ndarray, "_ 2"]]:
    """Rotate and translate a home, because real plans are neither anchored at the origin nor axis-aligned."""
    angle = 0.5 * np.pi * int(rng.integers(4))
    if rng.random() < config.rotated_share:
        angle = rng.uniform(0.0, 2.0 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    offset = rng.uniform(-config.offset_m, config.offset_m, 2)
    return [polygon @ turn.T + offset for polygon in polygons_m]


def _plan(
    names: Sequence[str], polygons_m: Sequence[np.ndarray], ceilings_m: Sequence[float], openings: Sequence[Opening]
) -> FloorPlan:
    ids = [name.replace(" ", "-") for name in names]
    rooms = [
        {
            "id": key,
            "name": name,
            "type": room_type_from_label(name),
            "polygon": polygon.tolist(),
            "ceiling_height_m": ceiling,
        }
        for key, name, polygon, ceiling in zip(ids, names, polygons_m, ceilings_m, strict=True)
    ]
    entries = [
        {
            "kind": _PLAN_KINDS[opening.kind],
            "line": _line(opening, polygons_m[opening.room]),
            "sill_m": opening.sill_m,
            "head_m": opening.head_m,
            "rooms": [ids[room] for room in (opening.room, opening.neighbour) if room >= 0],
        }
        for opening in openings
        # One entry serves both rooms.
        if opening.neighbour < 0 or opening.room < opening.neighbour
    ]
    document = {"name": "synthetic home", "rooms": rooms, "openings": entries}
    return FloorPlan.from_dict(document | {"opening_kinds": ["door", "window", "passage"]})


def _line(opening: Opening, polygon_m: Float[np.ndarray, "n 2"]) -> list[list[float]]:
    start = polygon_m[opening.wall]
    along = polygon_m[(opening.wall + 1) % len(polygon_m)] - start
    along = along / np.linalg.norm(along)
    return [(start + distance * along).tolist() for distance in (opening.start_m, opening.end_m)]


# Two splits never share a home.
TRAIN, VALIDATION, TEST = 0, 1, 2


def home_of(split: int, seed: int, index: int) -> tuple[Home, np.random.Generator]:
    """Return home number `index` of a split, and the generator for everything else that is drawn for it."""
    rng = np.random.default_rng([split, seed, index])
    return generate_home(rng, VARIED_HOMES if split == TRAIN else HomeConfig()), rng
