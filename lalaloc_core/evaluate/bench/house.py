"""Accuracy in a furnished house that others made, with metric plans and poses: spheres, views, turns, films and albums.

`DATA/rendered_house` has the plans, their spheres with poses (`views.json`, read as `posed_spheres`), and the program
`cut_album.py`, which cuts photographs of both storeys and writes their rooms to `truth.json`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.evaluate.bench.measured import Found, Setting, evaluate, summary
from lalaloc_core.evaluate.bench.turns import found_in_film, found_in_turns
from lalaloc_core.evaluate.calibrate.measured_errors import spots_of
from lalaloc_core.evaluate.runs.albums import RoomAlbum, RoomKey, album_entry
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import AnnotatedPhotographs, HeldoutScenes, ViewScenes, encode_jpeg
from lalaloc_core.learn.data.posed_spheres import VIEWS_FILE, PosedSpheres
from lalaloc_core.learn.data.synthetic.albums import two_views
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.photograph import StatedCamera

# Fields of view (degrees), and views of each sphere; those of turns.
_FIELDS_DEG, _VIEWS, _TURN_DEG, _TURN_VIEWS = (60.0, 67.0, 80.0, 106.0), 8, 80.0, 3
# Photographs of elsewhere that are added to the album: views of annotated rooms, and their field of view (degrees).
_ELSEWHERE, _ELSEWHERE_DEG = 5, 67.0


def bench_house(setting: Setting) -> dict[str, Any]:
    """Measure the house; nothing without its folder.

    Rows: spheres, and views by field of view, heading and what is stated; turns of three views and films; albums in the
    order of their names, without one, with the times of a walk and focal lengths, with photographs of elsewhere, and in
    a foreign plan.
    """
    if setting.house is None:
        return {}
    folder = setting.house
    rows: dict[str, Any] = {}
    for heading, known in (("known_heading", True), ("unknown_heading", False)):
        rows[f"sphere_{heading}"] = _localised(setting, folder, None, known=known)
        for field_deg in _FIELDS_DEG:
            for stated in ("field", "nothing"):
                views = {"field_deg": field_deg, "per_camera": _VIEWS, "stated": stated}
                rows[f"view_{field_deg:g}_{stated}_{heading}"] = _localised(setting, folder, views, known=known)
    spots = spots_of(ViewScenes(PosedSpheres(folder), _TURN_DEG, _TURN_VIEWS), "validation")
    rows |= {f"turn_{name}": summary(found) for name, found in found_in_turns(setting.model, spots).items()}
    scenes = list(map(PosedSpheres(folder).load, PosedSpheres(folder).scenes("validation")))
    films = [found_in_film(setting.model, scene.plan, camera) for scene in scenes for camera in scene.cameras]
    albums = {
        name: album.figures(setting.model.encoder, AlbumMemory()) for name, album in house_albums(setting).items()
    }
    return rows | {"film": summary(films), **albums}


def _localised(setting: Setting, folder: Path, views: dict[str, Any] | None, *, known: bool) -> dict[str, float]:
    info = RunInfo(
        label="house",
        dataset="rendered house",
        split="validation",
        data=str(folder),
        views=views,
        heading_known=known,
        bundle=str(setting.bundle.folder),
    )
    found = [Found.of(each.final_pose, each.truth, each.confidence) for each in evaluate(info)]
    return summary(found) | {"right_room": float(np.mean([each.right_room for each in found]))}


def house_albums(setting: Setting) -> dict[str, RoomAlbum]:
    """Return albums by name: see `bench_house`."""
    model, folder = setting.model, setting.house
    if folder is None:
        return {}
    own = _ground(model, {name: FloorPlan.from_json((folder / name).read_bytes()) for name in _plans(folder).values()})
    heldout = HeldoutScenes(homes=1)
    foreign = _ground(model, {name: heldout.load(name).plan for name in heldout.scenes("test")})
    plain, walk = _photographs(model, folder), _photographs(model, folder, "--exif", "--walk")
    others = [] if setting.annotated is None else AnnotatedPhotographs(setting.annotated).photographs[:_ELSEWHERE]
    rng, outside = np.random.default_rng(0), list[AlbumPhotograph]()
    for other in others:
        (pixels, _), _ = two_views(other.photograph.image(512, 1024), _ELSEWHERE_DEG, rng)
        outside.append(album_entry(model, f"elsewhere {other.name}", encode_jpeg(pixels), StatedCamera()))
    rooms: list[RoomKey] = [*plain.values(), *[None] * len(outside)]
    unnamed = [replace(each, name="") for each in plain]
    albums = {
        "album": RoomAlbum(own, list(plain), list(plain.values())),
        "album_without_order": RoomAlbum(own, unnamed, list(plain.values())),
        "album_walk": RoomAlbum(own, list(walk), list(walk.values())),
        "foreign_house": RoomAlbum(foreign, list(plain), [None] * len(plain)),
    }
    return albums | ({"album_with_elsewhere": RoomAlbum(own, [*plain, *outside], rooms)} if outside else {})


def _plans(folder: Path) -> dict[int, str]:
    """Return the file of the plan of each floor."""
    return {view["floor"]: view["plan"] for view in json.loads((folder / VIEWS_FILE).read_bytes())}


def _ground(model: LocalModel, plans: dict[str, FloorPlan]) -> AlbumGround:
    height_m = next(iter(plans.values())).camera_height_m
    grids = [model.grid(plan, height_m) for plan in plans.values()]
    return AlbumGround(tuple(plans), MergedPlans.of(list(plans.values()), grids, height_m))


def _photographs(model: LocalModel, folder: Path, *options: str) -> dict[AlbumPhotograph, RoomKey]:
    """Return the photographs that the house's program cuts, each with the plan and id of its room."""
    plans = _plans(folder)
    with tempfile.TemporaryDirectory(prefix="lalaloc-album-") as out:
        subprocess.run([sys.executable, str(folder / "cut_album.py"), out, *options], check=True)
        truth = json.loads(Path(out, "truth.json").read_bytes())
        return {
            album_entry(model, name, Path(out, name).read_bytes(), StatedCamera(), name=name): (
                plans[row["plan"]],
                row["room"],
            )
            for name, row in truth.items()
        }
