"""Photographs found with plans that were imported untouched, against the exact plans.

`python -m benchmarks.imported_plans` draws generated test homes as PNG, SVG, DXF and PDF, in six styles and with words
of twelve languages, imports the files with their scale and nothing else, and searches the imported plans for furnished
spheres with unknown heading. A photograph of a home whose file is refused is not found.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from benchmarks.drawn_files import FILE_FORMATS, FILE_STYLES, LANGUAGES, FileFormat, FileStyle, draw_file, draw_home
from benchmarks.harness import print_table_head, table_row
from benchmarks.opening_trust import query_of
from benchmarks.plan_drawing import HOME, Model, model_of
from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, import_plan
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import TEST, generate_home
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import Query

_NEAR_M, _IOU = 1.0, 0.9


@dataclass(frozen=True, eq=False)
class DrawnHome:
    """Home with its drawing's model, its photographs as queries, and the places of their cameras in its plan."""

    plan: FloorPlan
    model: Model
    queries: list[tuple[Query, Camera]]


@dataclass(frozen=True)
class Outcome:
    """Result of one file.

    Attributes:
        exact, found: photographs found in the exact and in the imported plan.
        photographs: number of photographs.
        rooms, rooms_found: rooms of the home, and those imported with an intersection over union of at least 0.9.
        openings, openings_found: doors and windows of the home, and those imported at the same place.
        refusal: reason of a refusal.
    """

    format: FileFormat
    style: FileStyle
    language: str
    exact: int
    found: int
    photographs: int
    rooms: int
    rooms_found: int = 0
    openings: int = 0
    openings_found: int = 0
    refusal: str | None = None


def homes(model: LocalModel, count: int, shots: int) -> Iterator[DrawnHome]:
    """Yield drawn test homes with furnished photographs."""
    scenes, renderers = GeneratedScenes(homes=1), split_renderer_cache(TEST, 0, None)
    for index in range(count):
        rng = np.random.default_rng([TEST, 0, index])
        thickness = float(rng.uniform(0.1, 0.25))
        home = generate_home(rng, replace(HOME, wall_thickness_m=(thickness, thickness)))
        cameras = tuple(
            Camera(
                name=str(number),
                position_m=shot.position_m,
                room_index=shot.room_index,
                heading=shot.heading,
                camera_height_m=shot.camera_height_m,
                photographs={scenes.appearances[0]: RenderedPhotograph(shot, renderers)},
            )
            for number, shot in enumerate(sample_shots(home, shots, rng))
        )
        scene = Scene(name=str(index), plan=home.plan, cameras=cameras)
        queries = [
            (query_of(model, scene, camera, model.grid(home.plan, camera.camera_height_m)), camera)
            for camera in cameras
        ]
        yield DrawnHome(home.plan, model_of(home, thickness), queries)


def count_found(model: LocalModel, plan: FloorPlan, home: DrawnHome, origin_m: tuple[float, float]) -> int:
    """Return how many photographs are found within 1 m in a plan whose origin lies at `origin_m` in the home's plan."""
    found = 0
    for query, camera in home.queries:
        place = model.localise(plan, model.grid(plan, query.camera_height.height_m), query).candidates[0].position_m
        found += math.dist(np.add(place, origin_m), camera.position_m) < _NEAR_M
    return found


def judge(
    model: LocalModel, home: DrawnHome, exact: int, file: tuple[FileFormat, FileStyle, str, int]
) -> Outcome | None:
    """Draw, import and search a file of a home; None for a style that the format does not have."""
    format, style, language, seed = file
    drawing = draw_home(home.model, style, language, np.random.default_rng([seed, 7]))
    drawn = draw_file(format, style, drawing, seed)
    if drawn is None:
        return None
    doors = [opening for opening in home.model.openings if opening.kind != "passage"]
    outcome = Outcome(format, style, language, exact, 0, len(home.queries), len(home.model.rooms), openings=len(doors))
    content, options = drawn
    try:
        imported = import_plan(content, ImportOptions.from_text(options))
        plan = imported.plan()
    except InvalidFloorPlanError as error:
        return replace(outcome, refusal=str(error))
    shift = _shift(plan, home.model)
    rooms = [shapely.affinity.translate(room.shape, *shift) for room in plan.rooms]
    lines = [
        shapely.affinity.translate(shapely.LineString(opening["line"]), *shift)
        for opening in imported.document.get("openings", [])
        if opening["kind"] != "passage"
    ]
    origin = (shift[0] + home.model.origin_m[0], shift[1] + home.model.origin_m[1])
    return replace(
        outcome,
        found=count_found(model, plan, home, origin),
        rooms_found=sum(any(_iou(room, other) >= _IOU for other in rooms) for room in home.model.rooms),
        openings_found=sum(any(_is_same(door.shape, line) for line in lines) for door in doors),
    )


def _shift(plan: FloorPlan, model: Model) -> tuple[float, float]:
    """Return the vector from the imported plan's frame to the drawing's: y of an SVG counts from its upper edge."""
    truth = shapely.union_all(model.rooms)
    read = shapely.union_all([room.shape for room in plan.rooms])
    shifts = [(0.0, 0.0), (0.0, model.size_m[1])]
    return max(shifts, key=lambda shift: shapely.intersection(truth, shapely.affinity.translate(read, *shift)).area)


def _iou(a: shapely.Polygon, b: shapely.Polygon) -> float:
    shared = shapely.intersection(a, b).area
    return shared / max(a.area + b.area - shared, 1e-9)


def _is_same(shape: shapely.Polygon, line: shapely.LineString) -> bool:
    shared = shapely.intersection(shape.buffer(0.3), line).length
    return shared >= 0.5 * max(line.length, 0.5 * shape.length - 0.3)


def print_tables(outcomes: Sequence[Outcome]) -> None:
    """Print the shares by format, style and language."""
    for name in ("format", "style", "language"):
        print_table_head(name, "n", "exact plan", "imported plan", "relative", "rooms", "doors and windows", "refused")
        values = list(dict.fromkeys(getattr(outcome, name) for outcome in outcomes))
        for value in [*values, "all"]:
            chosen = [outcome for outcome in outcomes if value in (getattr(outcome, name), "all")]
            n, exact, found = (sum(getattr(o, key) for o in chosen) for key in ("photographs", "exact", "found"))
            rooms = sum(o.rooms_found for o in chosen) / max(sum(o.rooms for o in chosen), 1)
            doors = sum(o.openings_found for o in chosen) / max(sum(o.openings for o in chosen), 1)
            shares = [f"{100 * share:.0f} %" for share in (exact / n, found / n, found / max(exact, 1), rooms, doors)]
            print(table_row(value, n, *shares, sum(o.refusal is not None for o in chosen)), flush=True)
        print()


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--homes", type=int, default=24, help="homes; each is drawn in one style and language per format"
    )
    parser.add_argument("--shots", type=int, default=2, help="photographs per home")
    parser.add_argument("--formats", nargs="+", choices=FILE_FORMATS, default=FILE_FORMATS)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    arguments = parser.parse_args()
    model = LocalModel(Bundle.open(arguments.bundle))
    outcomes: list[Outcome] = []
    for index, home in enumerate(homes(model, arguments.homes, arguments.shots)):
        exact = count_found(model, home.plan, home, (0.0, 0.0))
        for offset, format in enumerate(arguments.formats):
            # Formats of a home differ in style and language, so that few homes show all of them.
            style, language = FILE_STYLES[(index + offset) % len(FILE_STYLES)], LANGUAGES[(index + 3 * offset) % 12]
            if format in ("svg", "dxf") and style == "scanned":
                style = FILE_STYLES[index % (len(FILE_STYLES) - 1)]
            outcome = judge(model, home, exact, (format, style, language, index))
            if outcome is not None:
                outcomes.append(outcome)
                worse = outcome.found < outcome.exact or outcome.rooms_found < outcome.rooms
                if worse or outcome.refusal:
                    print(f"home {index}: {outcome}", flush=True)
    print_tables(outcomes)


if __name__ == "__main__":
    main()
