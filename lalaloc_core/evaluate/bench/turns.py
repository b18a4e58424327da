"""Accuracy of turns on the spot: some views, photographs once around with known angles or by overlap, and films."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.bench.measured import Found, Setting, summary
from lalaloc_core.evaluate.calibrate.measured_errors import Spot, photograph_of, spots
from lalaloc_core.evaluate.methods.lalaloc import found_pose
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.galleries import answers_in_galleries, score_galleries
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RendererCache, split_renderer_cache
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
from lalaloc_core.learn.data.views import encode_jpeg
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.answers.documents import Ground
from lalaloc_core.localise.answers.turns import Turn
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.search.turn_search import TurnLocalisation
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film, read_film
from lalaloc_core.photograph.turn_angles import TurnAngles

# Photographs once around; a spot per home, so that figures are of many homes.
_PHOTOGRAPHS = 12
_SPLIT = SPLIT_NUMBERS["test"]
# Phone that films.
_FILMING = Phone(width=360, height=480)
# Size of the annotated spheres that films are cut from, and galleries of each.
_SPHERE_SIZE, _GALLERIES = (1024, 2048), 1


def bench_turns(setting: Setting) -> dict[str, Any]:
    """Measure three views of 80°, a third of a turn apart, heading unknown, 4 spots in each furnished test home."""
    answers: dict[str, list[Found]] = {"known_angles": [], "unknown_angles": []}
    for spot in spots(setting.homes, "test", setting.textures):
        for row, answer in zip(answers, _at_spot(spot, setting.model), strict=True):
            answers[row].append(answer)
    return {row: summary(found) for row, found in answers.items()}


def _at_spot(spot: Spot, model: LocalModel) -> tuple[Found, Found]:
    """Localise the views of one spot with known and with unknown angles between them."""
    (plan, views), manifest = spot, model.bundle.manifest
    height = CameraHeight(views[0].camera_height_m)
    opened = [photograph_of(view).open(patch_size(manifest)) for view in views]
    ground = Ground(plan, model.grid(plan, height.height_m))

    def found(turns: Sequence[float | None]) -> Found:
        turn = Turn.of_headings(opened, [UNKNOWN_HEADING] * len(opened), height, turns, std=0.0)
        answer = model.search_turn(turn, ground)
        return Found.of(answer.joint, views[0], answer.confidence(manifest))

    return found(spot.turns), found([None] * len(opened))


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
    phone, renderers = Phone(), split_renderer_cache(_SPLIT, 0, setting.textures)
    rows: dict[str, list[tuple[Found, _Links]]] = {}
    for index in range(setting.homes):
        home, rng = home_of(_SPLIT, 0, index)
        (shot,) = sample_shots(home, 1, rng, "full")
        frames = photographs_of_turn(shot, renderers, phone, _PHOTOGRAPHS, rng)
        found = _of_turn(setting.model, shot, frames, phone)
        found["film"] = _of_film(setting.model, shot, renderers, rng)
        for name, row in found.items():
            rows.setdefault(name, []).append(row)
    report: dict[str, Any] = {name: _film_figures(found) for name, found in rows.items()}
    return report if setting.annotated is None else report | _annotated_films(setting)


def _film_figures(rows: Sequence[tuple[Found, _Links]]) -> dict[str, float]:
    angles_deg, linked, field = np.array([links for _, links in rows]).T
    return summary([found for found, _ in rows]) | {
        "median_angle_error_deg": float(np.nanmedian(angles_deg)) if np.isfinite(angles_deg).any() else math.nan,
        "linked_share": float(linked.mean()),
        "median_field_error": float(np.median(field)),
    }


def _of_film(model: LocalModel, shot: Shot, renderers: RendererCache, rng: np.random.Generator) -> tuple[Found, _Links]:
    instants = turn_by_hand(rng)
    content = encode_film(film_of_turn(shot, renderers, _FILMING, instants))
    film = read_film(content, patch_size=patch_size(model.bundle.manifest))
    turns = _turns_at(film, instants)
    found = _localised_film(model, shot.home.plan, film, shot.camera_height_m)
    # The first frame that is kept need not look along the shot's heading.
    answer = Found.of(found.pictures[0], shot, found.confidence(model.bundle.manifest), turns[0])
    return answer, _Links.of(film.photographs, film.angles, [turn - turns[0] for turn in turns], _FILMING)


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
        answer = Found.of(found.pictures[0], shot, found.confidence(model.bundle.manifest))
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


def _annotated_films(setting: Setting) -> dict[str, Any]:
    """Measure films once around, cut from annotated spheres, and these spheres, in galleries, with an unknown heading.

    Hand-held as in generated homes but without parallax, as nothing is known from beside the sphere's centre.
    """
    assert setting.annotated is not None
    model, manifest = setting.model, setting.bundle.manifest
    scenes, height = AnnotatedPhotographs(setting.annotated), CameraHeight(CAMERA_HEIGHT_M)
    photographs = {photograph.name: photograph for photograph in scenes.photographs}
    films: dict[str, tuple[Film, float]] = {}
    found: dict[str, list[Prediction]] = {"annotated_film": [], "annotated_sphere": []}
    for key in scenes.keys(_GALLERIES):
        photograph, scene = photographs[key.photograph], scenes.load(key.scene)
        if key.photograph not in films:
            films[key.photograph] = _filmed(model, photograph)
        film, turn = films[key.photograph]
        turned = _localised_film(model, scene.plan, film, CAMERA_HEIGHT_M)
        found["annotated_film"].append(_prediction(scene, turned.pictures[0], turn, turned.confidence(manifest)))
        pixels = photograph.photograph.image(manifest.image_height, manifest.image_width)
        grid = model.grid(scene.plan, CAMERA_HEIGHT_M)
        sphere = model.localise(scene.plan, grid, model.encoder.spheres.query(pixels, None, height))
        believed = sphere.confidence(manifest.confidence)
        confidence = None if believed is None else believed.position
        found["annotated_sphere"].append(_prediction(scene, sphere, 0.0, confidence))
    return {name: _gallery_figures(predictions, scenes.photographs) for name, predictions in found.items()}


def _filmed(model: LocalModel, photograph: AnnotatedPhotograph) -> tuple[Film, float]:
    """Return a film of a sphere, and the turn (radians) from the sphere's centre to the first frame that was kept."""
    instants = turn_by_hand(np.random.default_rng(zlib.crc32(photograph.name.encode())))
    sphere = photograph.photograph.image(*_SPHERE_SIZE)
    frames = (exposed(sphere, _FILMING.camera, instant, azimuth=instant.turn) for instant in instants)
    film = read_film(encode_film(frames), patch_size=patch_size(model.bundle.manifest))
    return film, _turns_at(film, instants)[0]


def _prediction(scene: Scene, found: Localisation, turn: float, confidence: float | None) -> Prediction:
    (camera,) = scene.cameras
    rooms = [candidate.room_index for candidate in found.candidates]
    pose = found_pose(found.query, found.candidates[0])
    turned = Pose.at(pose.position_m, pose.room_index, pose.heading - turn)
    return Prediction(
        scene=scene.name,
        camera=camera.name,
        room=str(camera.room_index),
        camera_height_m=camera.camera_height_m,
        truth=Pose.at(camera.position_m, camera.room_index, camera.heading),
        stages={found.stage: turned},
        room_rank=rooms.index(camera.room_index) + 1 if camera.room_index in rooms else None,
        confidence=confidence,
    )


def _gallery_figures(predictions: Sequence[Prediction], photographs: Sequence[AnnotatedPhotograph]) -> dict[str, Any]:
    answers = answers_in_galleries(predictions, photographs)
    scores = score_galleries(answers)
    return {
        "n": scores.galleries,
        "located": scores.located,
        "right_room": scores.right_room,
        "among_5": scores.among_5,
        "mean_confidence": float(np.mean([answer.confidence or 0.0 for answer in answers])),
        "within_1m": float(np.mean([answer.within_1m for answer in answers])),
        "expected_calibration_error": scores.calibration_error,
        "by_photograph": dict(scores.by_photograph),
    }
