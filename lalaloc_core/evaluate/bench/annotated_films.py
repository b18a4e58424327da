"""Films cut from annotated photographs of real rooms, localised in galleries, beside the spheres they are cut from."""

from __future__ import annotations

import dataclasses
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.evaluate.methods.method import Pose, PredictedCandidate
from lalaloc_core.evaluate.runs.galleries import answers_in_galleries, score_galleries
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.data.synthetic.hand_held import encode_film, exposed, turn_by_hand
from lalaloc_core.learn.data.synthetic.turned import Phone
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.sequence.turn_localisation import LinkedTurn
from lalaloc_core.photograph.film import Film, read_film

# Phone that films.
FILMING = Phone(width=360, height=480)
# Size of the spheres that films are cut from, and galleries of each.
_SPHERE_SIZE, _GALLERIES = (1024, 2048), 1


def annotated_films(model: LocalModel, folder: Path) -> dict[str, Any]:
    """Measure films once around, cut from annotated spheres, and these spheres, with an unknown heading.

    Hand-held as in generated homes but without parallax, as nothing is known from beside the sphere's centre.
    """
    scenes = AnnotatedPhotographs(folder)
    photographs = {photograph.name: photograph for photograph in scenes.photographs}
    films: dict[str, tuple[Film, float]] = {}
    found: dict[str, list[Prediction]] = {"annotated_film": [], "annotated_sphere": []}
    for key in scenes.keys(_GALLERIES):
        photograph, scene = photographs[key.photograph], scenes.load(key.scene)
        (camera,), plan = scene.cameras, scene.plan
        grid, height = model.grid(plan, CAMERA_HEIGHT_M), CameraHeight(CAMERA_HEIGHT_M)
        if key.photograph not in films:
            films[key.photograph] = _filmed(model, photograph)
        film, turn = films[key.photograph]
        turned = model.localise_turn(plan, grid, film.photographs, LinkedTurn.of(film.angles), height)
        confidence = turned.confidence(model.bundle.manifest)
        found["annotated_film"].append(_prediction(scene.name, camera, turned.pictures[0], turn, confidence))
        size = model.bundle.manifest.image_height, model.bundle.manifest.image_width
        query = model.encoder.spheres.query(photograph.photograph.image(*size), None, height)
        sphere = model.localise(plan, grid, query)
        believed = sphere.confidence(model.bundle.manifest.confidence)
        confidence = None if believed is None else believed.position
        found["annotated_sphere"].append(_prediction(scene.name, camera, sphere, 0.0, confidence))
    return {name: _summary(predictions, scenes.photographs) for name, predictions in found.items()}


def _filmed(model: LocalModel, photograph: AnnotatedPhotograph) -> tuple[Film, float]:
    """Return a film of a sphere, and the turn (radians) from the sphere's centre to the first frame that was kept."""
    instants = turn_by_hand(np.random.default_rng(zlib.crc32(photograph.name.encode())))
    sphere = photograph.photograph.image(*_SPHERE_SIZE)
    frames = (exposed(sphere, FILMING.camera, instant, azimuth=instant.turn) for instant in instants)
    film = read_film(encode_film(frames), patch_size=patch_size(model.bundle.manifest))
    times_s, turns = [instant.time_s for instant in instants], [instant.turn for instant in instants]
    return film, float(np.interp(film.times_s[0], times_s, turns))


def _prediction(scene: str, camera: Camera, found: Localisation, turn: float, confidence: float | None) -> Prediction:
    """Return a result as a prediction of the sphere's pose, from which the photograph is turned."""
    rooms = [candidate.room_index for candidate in found.candidates]
    poses = [
        Pose.at(each.position_m, each.room_index, photograph_heading(found.query, each) - turn, each.cost)
        for each in found.candidates
    ]
    return Prediction(
        scene=scene,
        camera=camera.name,
        room=str(camera.room_index),
        camera_height_m=camera.camera_height_m,
        truth=Pose.at(camera.position_m, camera.room_index, camera.heading),
        stages={found.stage: poses[0]},
        room_rank=rooms.index(camera.room_index) + 1 if camera.room_index in rooms else None,
        signals={stage: dataclasses.asdict(signals) for stage, signals in found.signals.items()},
        candidates=tuple(
            PredictedCandidate(pose=pose, terms=each.terms, probability=share)
            for pose, each, share in zip(poses, found.candidates, found.posterior.candidate, strict=True)
        ),
        confidence=confidence,
    )


def _summary(predictions: list[Prediction], photographs: tuple[AnnotatedPhotograph, ...]) -> dict[str, Any]:
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
