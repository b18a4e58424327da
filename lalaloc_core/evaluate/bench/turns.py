"""Accuracy of turns on the spot: some views, photographs once around with known angles or by overlap, and films."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.bench.measured import Found, Setting, best_pose, evaluate, summary
from lalaloc_core.evaluate.calibrate.measured_errors import Spot, photograph_of, spots
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.galleries import answers_in_galleries, score_galleries
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import CAMERA_HEIGHT_M, AnnotatedPhotograph, AnnotatedPhotographs, encode_jpeg
from lalaloc_core.learn.data.dataset import Camera, DatasetPhotograph, Scene
from lalaloc_core.learn.data.synthetic.turned import (
    Frame,
    Instant,
    Phone,
    encode_film,
    exposed,
    film_of_turn,
    photographs_of_turn,
    turn_by_hand,
)
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.localise.answers.documents import Ground
from lalaloc_core.localise.answers.turns import Turn
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.localise.search.turn_search import TurnLocalisation
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film, read_film
from lalaloc_core.photograph.turn_angles import TurnAngles

# Photographs once around; a spot per home, so that figures are of many homes.
_PHOTOGRAPHS = 12
# Phone that films.
_FILMING = Phone(width=360, height=480)
# Size of the annotated spheres that films are cut from, and galleries of each.
_SPHERE_SIZE, _GALLERIES = (1024, 2048), 1


def bench_turns(setting: Setting) -> dict[str, Any]:
    """Measure three views of 80°, a third of a turn apart, heading unknown, 4 spots in each furnished test home."""
    found = found_in_turns(setting.model, spots(setting.homes, "test", setting.textures))
    return {row: summary(answers) for row, answers in found.items()}


def found_in_turns(model: LocalModel, places: Iterable[Spot]) -> dict[str, list[Found]]:
    """Return the answers for the views of spots, by what is known of their angles."""
    manifest = model.bundle.manifest
    answers: dict[str, list[Found]] = {"known_angles": [], "unknown_angles": []}
    for spot in places:
        (plan, views), height = spot, CameraHeight(spot.views[0].camera_height_m)
        ground = Ground(plan, model.grid(plan, height.height_m))
        opened = [photograph_of(view).open(patch_size(manifest)) for view in views]
        for row, turns in (("known_angles", spot.turns), ("unknown_angles", [None] * len(opened))):
            turn = Turn.of_headings(opened, [UNKNOWN_HEADING] * len(opened), height, turns, std=0.0)
            answer = model.search_turn(turn, ground)
            answers[row].append(Found.of(best_pose(answer.joint), views[0], answer.confidence(manifest)))
    return answers


class _Links(NamedTuple):
    """Errors of a turn's angles (degrees) and field (share), and the share of photographs that others overlap."""

    angles_deg: float
    linked_share: float
    field_share: float

    @classmethod
    def of(
        cls, photographs: Sequence[Photograph], angles: Sequence[TurnAngles], turns: Sequence[float], phone: Phone
    ) -> _Links:
        """Compare angles with true ones; the error of angles is the median within groups that overlap."""
        groups: dict[int, list[float]] = {}
        for angle, turn in zip(angles, turns, strict=True):
            groups.setdefault(angle.group, []).append(float(wrap_angle(angle.heading - turn)))
        missed = [
            abs(math.degrees(float(wrap_angle(error - np.median(group)))))
            for group in groups.values()
            if len(group) > 1
            for error in group
        ]
        field = abs(math.degrees(photographs[0].hfov.value) / phone.hfov_deg - 1.0)
        return cls(float(np.median(missed)) if missed else math.nan, len(missed) / len(turns), field)


def bench_films(setting: Setting) -> dict[str, Any]:
    """Measure turns of twelve photographs of 53° portrait in furnished test homes, with an arm of 0.4 m, and films.

    The heading is unknown. The angles are stated, or follow from overlap, with the field of view stated or unknown. A
    film lasts 8 s, nothing is stated about it, and a hand holds the phone. Of annotated photographs, films are cut from
    their spheres; see `_annotated_films`.
    """
    rows: dict[str, list[tuple[Found, _Links]]] = {}
    for (shot,), rng in setting.shots(1):
        frames = photographs_of_turn(shot, setting.renderers, Phone(), _PHOTOGRAPHS, rng)
        found = _of_turn(setting.model, shot, frames, Phone())
        found["film"] = _of_film(setting, shot, rng)
        for name, row in found.items():
            rows.setdefault(name, []).append(row)
    report: dict[str, Any] = {name: _film_figures(found) for name, found in rows.items()}
    return report if setting.annotated is None else report | _annotated_films(setting, setting.annotated)


def _film_figures(rows: Sequence[tuple[Found, _Links]]) -> dict[str, float]:
    angles_deg, linked, field = np.array([links for _, links in rows]).T
    return summary([found for found, _ in rows]) | {
        "median_angle_error_deg": float(np.nanmedian(angles_deg)) if np.isfinite(angles_deg).any() else math.nan,
        "linked_share": float(linked.mean()),
        "median_field_error": float(np.median(field)),
    }


def _of_film(setting: Setting, shot: Shot, rng: np.random.Generator) -> tuple[Found, _Links]:
    model, instants = setting.model, turn_by_hand(rng)
    content = encode_film(film_of_turn(shot, setting.renderers, _FILMING, instants))
    film = read_film(content, patch_size=patch_size(model.bundle.manifest))
    turns = _turns_at(film, instants)
    found = _localised_film(model, shot.home.plan, film, shot.camera_height_m)
    pose = _turned(best_pose(found.pictures[0]), turns[0])
    answer = Found.of(pose, shot, found.confidence(model.bundle.manifest))
    return answer, _Links.of(film.photographs, film.angles, [turn - turns[0] for turn in turns], _FILMING)


def _turned(pose: Pose, turn: float) -> Pose:
    """Return the pose of the first frame of a film, whose kept frames begin after a turn (radians)."""
    return Pose.at(pose.position_m, pose.room_index, pose.heading - turn)


def _turns_at(film: Film, instants: Sequence[Instant]) -> list[float]:
    """Return the turn (radians) at each frame that was kept."""
    times_s, turns = [instant.time_s for instant in instants], [instant.turn for instant in instants]
    return np.interp(film.times_s, times_s, turns).tolist()


def _localised_film(model: LocalModel, plan: FloorPlan, film: Film, camera_height_m: float) -> TurnLocalisation:
    height, grid = CameraHeight(camera_height_m), model.grid(plan, camera_height_m)
    return model.localise_turn(plan, grid, film.photographs, film.angles, height)


def _of_turn(model: LocalModel, shot: Shot, frames: Sequence[Frame], phone: Phone) -> dict[str, tuple[Found, _Links]]:
    """Return the results for one turn by what is known."""
    plan, height = shot.home.plan, CameraHeight(shot.camera_height_m)
    grid = model.grid(plan, shot.camera_height_m)
    contents = [encode_jpeg(frame.pixels) for frame in frames]
    turns = [float(wrap_angle(frame.heading - frames[0].heading)) for frame in frames]

    def located(photographs: Sequence[Photograph], angles: Sequence[TurnAngles]) -> tuple[Found, _Links]:
        found = model.localise_turn(plan, grid, photographs, angles, height)
        answer = Found.of(best_pose(found.pictures[0]), shot, found.confidence(model.bundle.manifest))
        return answer, _Links.of(photographs, angles, turns, phone)

    rows: dict[str, tuple[Found, _Links]] = {}
    for name, hfov_deg in (("overlap", phone.hfov_deg), ("overlap_unknown_field", None)):
        photographs, angles = model.open_turn(contents, StatedCamera(projection="perspective", hfov_deg=hfov_deg))
        rows[name] = located(photographs, angles)
        if hfov_deg is not None:
            exact = [
                replace(angle, group=0, heading=turn, heading_sd=0.0) for angle, turn in zip(angles, turns, strict=True)
            ]
            rows["stated"] = located(photographs, exact)
    return rows


def _annotated_films(setting: Setting, folder: Path) -> dict[str, Any]:
    """Measure films once around, cut from annotated spheres, and these spheres, in galleries, with an unknown heading.

    Hand-held as in generated homes but without parallax, as nothing is known from beside the sphere's centre.
    """
    scenes = AnnotatedPhotographs(folder)
    keys, by_name = scenes.keys(_GALLERIES), {photograph.name: photograph for photograph in scenes.photographs}
    film_of = cache(lambda name: _filmed(setting.model, name, by_name[name].photograph))
    filmed: list[Prediction] = []
    for key in keys:
        (film, turn), scene = film_of(key.photograph), scenes.load(key.scene)
        found = _localised_film(setting.model, scene.plan, film, CAMERA_HEIGHT_M)
        filmed.append(_prediction(scene, found, turn, found.confidence(setting.bundle.manifest)))
    spheres = evaluate(
        RunInfo(
            label="annotated spheres",
            dataset=scenes.description,
            split="test",
            data=str(folder),
            heading_known=False,
            limit=len(keys),
            bundle=str(setting.bundle.folder),
        )
    )
    rows = {"annotated_film": filmed, "annotated_sphere": spheres}
    return {name: _gallery_figures(predictions, scenes.photographs) for name, predictions in rows.items()}


def found_in_film(model: LocalModel, plan: FloorPlan, camera: Camera) -> Found:
    """Return the answer for a film once around, cut from a camera's sphere, with an unknown heading."""
    (photograph,) = camera.photographs.values()
    film, turn = _filmed(model, camera.name, photograph)
    found = _localised_film(model, plan, film, camera.camera_height_m)
    pose = _turned(best_pose(found.pictures[0]), turn)
    return Found.of(pose, camera, found.confidence(model.bundle.manifest))


def _filmed(model: LocalModel, name: str, photograph: DatasetPhotograph) -> tuple[Film, float]:
    """Return a film of a sphere, and the turn (radians) from the sphere's centre to the first frame that was kept."""
    instants = turn_by_hand(np.random.default_rng(zlib.crc32(name.encode())))
    sphere = photograph.image(*_SPHERE_SIZE)
    frames = (exposed(sphere, _FILMING.camera, instant, azimuth=instant.turn) for instant in instants)
    film = read_film(encode_film(frames), patch_size=patch_size(model.bundle.manifest))
    return film, _turns_at(film, instants)[0]


def _prediction(scene: Scene, turned: TurnLocalisation, turn: float, confidence: float | None) -> Prediction:
    (camera,), found = scene.cameras, turned.pictures[0]
    rooms = [candidate.room_index for candidate in found.candidates]
    return Prediction(
        scene=scene.name,
        camera=camera.name,
        room=str(camera.room_index),
        camera_height_m=camera.camera_height_m,
        truth=Pose.at(camera.position_m, camera.room_index, camera.heading),
        stages={found.stage: _turned(best_pose(found), turn)},
        room_rank=rooms.index(camera.room_index) + 1 if camera.room_index in rooms else None,
        confidence=confidence,
    )


def _gallery_figures(predictions: Sequence[Prediction], photographs: Sequence[AnnotatedPhotograph]) -> dict[str, Any]:
    answers = answers_in_galleries(predictions, photographs)
    scores = score_galleries(answers)
    shares = {name: getattr(scores, name) for name in ("located", "right_room", "among_5")}
    return {
        "n": scores.galleries,
        **shares,
        "mean_confidence": float(np.mean([answer.confidence or 0.0 for answer in answers])),
        "within_1m": float(np.mean([answer.within_1m for answer in answers])),
        "expected_calibration_error": scores.calibration_error,
        "by_photograph": dict(scores.by_photograph),
    }
