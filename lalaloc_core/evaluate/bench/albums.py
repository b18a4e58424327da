"""Accuracy of albums: photographs of a walk through generated homes, spheres, and photographs of real rooms."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.evaluate.bench.measured import Found, Setting, best_pose, summary, timed
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.albums import AlbumCase, album_entry
from lalaloc_core.evaluate.runs.score import expected_calibration_error
from lalaloc_core.learn.data import CAMERA_HEIGHT_M, AnnotatedPhotograph, AnnotatedPhotographs, Split, encode_jpeg
from lalaloc_core.learn.data.drawn_rooms import plan_of_rooms
from lalaloc_core.learn.data.posed_spheres import PosedSpheres, annotated
from lalaloc_core.learn.data.synthetic.albums import taken_album, two_views
from lalaloc_core.learn.synth.furniture.furnish import FurnitureLevel
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import stated_height
from lalaloc_core.photograph import StatedCamera
from lalaloc_core.photograph.exif import Taken

_PHOTOGRAPHS = 20
# Rooms of an album of annotated and of path-traced ones, their distance (m), and the field of view (degrees) of their
# two photographs.
_ROOMS = {"annotated": 10, "rooms": 20}
_APART_M, _FIELD_DEG = 3.0, 70.0
_BEGIN = datetime(2026, 1, 1, 12)


def bench_albums(setting: Setting) -> dict[str, Any]:
    """Measure albums of 20 photographs, with unknown field of view, camera height and heading.

    Rows: in the order of a walk, without order, each alone, and as spheres; of annotated photographs, two views of each
    in albums of ten rooms, without doors or order, and of path-traced rooms in albums of twenty. Photographs that are
    refused, as overexposed walls can be taken for paper, are counted and in no other figure.
    """
    model, refused = setting.model, 0
    scores: defaultdict[str, list[Found]] = defaultdict(list)
    clicks, seconds, again_s = list[int](), list[float](), list[float]()
    for index in range(setting.homes):
        case = home_album(setting, index, spheres=False)
        refused += _PHOTOGRAPHS - len(case.photographs)
        memory = AlbumMemory()
        solve_s, walk = timed(_solved, model, case, memory)
        seconds.append(solve_s)
        scores["walk"] += walk
        scores["without_order"] += _solved(model, case.without_order, memory)
        scores["each_alone"] += _alone(model, case)
        clicks_s, count = timed(case.clicks, model, memory)
        clicks.append(count)
        again_s.append(clicks_s / (count + 1))
        scores["spheres"] += _solved(model, home_album(setting, index, spheres=True), AlbumMemory())
    for name, cases in galleries(setting).items():
        for case in cases:
            scores[name] += _solved(model, case, AlbumMemory())
            scores[f"{name}_each_alone"] += _alone(model, case)
    return {row: _figures(found) for row, found in scores.items()} | {
        "refused_photographs": refused,
        "clicks_per_album": float(np.mean(clicks)),
        "median_solve_s": float(np.median(seconds)),
        "median_again_s": float(np.median(again_s)),
    }


def home_album(
    setting: Setting, index: int, *, spheres: bool = False, split: Split = "test", furniture: FurnitureLevel = "full"
) -> AlbumCase:
    """Return an album of a generated home, without photographs that are refused."""
    model = setting.model
    plan, taken = taken_album(
        split, index, _PHOTOGRAPHS, spheres=spheres, furniture=furniture, textures=setting.textures
    )
    projection = "equirectangular" if spheres else "perspective"
    photographs, truth = list[AlbumPhotograph](), list[Pose]()
    for number, (pixels, spot) in enumerate(taken):
        with suppress(InvalidPhotographError):
            photographs.append(_entry(model, number, pixels, projection, spot.taken_s))
            truth.append(Pose.at(spot.position_m, spot.room_index, spot.heading))
    return AlbumCase.of(model, plan, photographs, truth)


def galleries(setting: Setting) -> dict[str, Iterator[AlbumCase]]:
    """Return albums of annotated photographs and of path-traced rooms: two views of each room."""
    found = {}
    if setting.annotated is not None:
        found["annotated"] = [each for each in AnnotatedPhotographs(setting.annotated).photographs if each.counts]
    if setting.rooms is not None:
        found["rooms"] = annotated(PosedSpheres(setting.rooms), "validation")
    return {name: _albums_of_rooms(setting.model, usable, _ROOMS[name]) for name, usable in found.items()}


def _albums_of_rooms(model: LocalModel, usable: Sequence[AnnotatedPhotograph], rooms: int) -> Iterator[AlbumCase]:
    """Yield an album for every photograph: its room with others, drawn at random."""
    for number, own in enumerate(usable):
        rng = np.random.default_rng([7, number])
        others = [photograph for photograph in usable if photograph is not own]
        chosen = [own, *(others[index] for index in rng.permutation(len(others))[: rooms - 1])]
        places, left_m = [], 0.0
        for photograph in chosen:
            outline_m = photograph.outlines[0].polygon_m
            places.append(np.array([left_m, 0.0]) - outline_m.min(axis=0))
            left_m += float(np.ptp(outline_m[:, 0])) + _APART_M
        moved = [each.outlines[0].moved(place) for each, place in zip(chosen, places, strict=True)]
        plan = plan_of_rooms(f"rooms with {own.name}", moved, CAMERA_HEIGHT_M)
        photographs, truth = list[AlbumPhotograph](), list[Pose]()
        for photograph, place in zip(chosen, places, strict=True):
            room_index = int(plan.room_index_at(place[None])[0])
            for pixels, azimuth in two_views(photograph.photograph.image(512, 1024), _FIELD_DEG, rng):
                photographs.append(_entry(model, len(photographs), pixels, "perspective", None))
                truth.append(Pose.at(place, room_index, azimuth))
        yield AlbumCase.of(model, plan, photographs, truth)


def _entry(
    model: LocalModel, number: int, pixels: UInt8[np.ndarray, "h w 3"], projection: str, taken_s: float | None
) -> AlbumPhotograph:
    at = None if taken_s is None else _BEGIN + timedelta(seconds=int(taken_s))
    taken = Taken(at=at, width=pixels.shape[1], height=pixels.shape[0])
    return album_entry(model, f"{number:03d}", encode_jpeg(pixels), StatedCamera(projection=projection), taken)


def _solved(model: LocalModel, case: AlbumCase, memory: AlbumMemory) -> list[Found]:
    pins = case.solve(model, memory)
    poses = (None if pin.pose is None else case.pose(pin.pose) for pin in pins)
    return [Found.of(pose, truth, pin.confidence) for pose, truth, pin in zip(poses, case.truth, pins, strict=True)]


def _alone(model: LocalModel, case: AlbumCase) -> list[Found]:
    """Localise each photograph alone, as the service does."""
    ground, manifest = case.ground, model.bundle.manifest
    found = []
    for photograph, truth in zip(case.photographs, case.truth, strict=True):
        query = model.encoder.query(photograph.photograph, None, stated_height(ground.plan, None))
        answer = model.localise(ground.plan, ground.grid, query)
        best = answer.candidates[0]
        room_share = float(answer.posterior.pose[ground.grid.poses.room_index == best.room_index].sum())
        confidence = answer.confidence(manifest.confidence_for(view=query.is_view))
        fit = 1.0 if confidence is None else confidence.fit
        found.append(Found.of(best_pose(answer), truth, fit * room_share))
    return found


def _figures(found: Sequence[Found]) -> dict[str, float]:
    """Return the summary with the confidence of the room, which is no probability of a position."""
    _, _, confidence, right_room = np.array(found).T
    figures = summary(found)
    del figures["median_cm"]
    calibration_error = expected_calibration_error(confidence, right_room.astype(bool))
    return figures | {"right_room": float(right_room.mean()), "expected_calibration_error": calibration_error}
