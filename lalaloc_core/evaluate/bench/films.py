"""Accuracy of turns once around: photographs with stated angles and by overlap, and films, at the end of an arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.bench.annotated_films import FILMING, annotated_films
from lalaloc_core.evaluate.runs.score import expected_calibration_error
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RendererCache, split_renderer_cache
from lalaloc_core.learn.data.synthetic.hand_held import encode_film, turn_by_hand
from lalaloc_core.learn.data.synthetic.turned import Frame, Phone, film_of_turn, photographs_of_turn
from lalaloc_core.learn.data.views import encode_jpeg
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation
from lalaloc_core.localise.sequence.turn_localisation import LinkedTurn
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import read_film
from lalaloc_core.photograph.turn_angles import TurnAngles

# Photographs once around; a spot per home, so that figures are of many homes.
_PHOTOGRAPHS = 12
_SPLIT = SPLIT_NUMBERS["test"]


class _Row(NamedTuple):
    """Errors of position (m), heading (radians), angles (degrees) and field (share) of a turn, and its confidence."""

    error_m: float
    turned: float
    confidence: float
    angles_deg: float
    linked_share: float
    field_share: float


def bench_films(bundle: Bundle, homes: int, textures: Path | None, annotated: Path | None) -> dict[str, Any]:
    """Measure turns of twelve photographs of 53° portrait in furnished test homes, with an arm of 0.4 m, and films.

    The heading is unknown. The angles are stated, or follow from overlap, with the field of view stated or unknown. A
    film lasts 8 s, nothing is stated about it, and a hand holds the phone. With `annotated`, a folder of annotated
    photographs, films are cut from these; see `annotated_films`.
    """
    model, phone = LocalModel(bundle), Phone()
    renderers = split_renderer_cache(_SPLIT, 0, textures)
    rows: dict[str, list[_Row]] = {}
    for index in range(homes):
        home, rng = home_of(_SPLIT, 0, index)
        (shot,) = sample_shots(home, 1, rng, "full")
        frames = photographs_of_turn(shot, renderers, phone, _PHOTOGRAPHS, rng)
        for name, row in _of_turn(model, shot, frames, phone).items():
            rows.setdefault(name, []).append(row)
        rows.setdefault("film", []).append(_of_film(model, shot, renderers, rng))
    report: dict[str, Any] = {name: _summary(found) for name, found in rows.items()}
    return report if annotated is None else report | annotated_films(model, annotated)


def _of_film(model: LocalModel, shot: Shot, renderers: RendererCache, rng: np.random.Generator) -> _Row:
    """Return the result for a film."""
    instants = turn_by_hand(rng)
    content = encode_film(film_of_turn(shot, renderers, FILMING, instants))
    film = read_film(content, patch_size=patch_size(model.bundle.manifest))
    times_s = [instant.time_s for instant in instants]
    turns = np.interp(film.times_s, times_s, [instant.turn for instant in instants])
    height = CameraHeight(shot.camera_height_m)
    grid = model.grid(shot.home.plan, shot.camera_height_m)
    found = model.localise_turn(shot.home.plan, grid, film.photographs, LinkedTurn.of(film.angles), height)
    errors = _angle_errors(film.photographs, film.angles, (turns - turns[0]).tolist(), FILMING)
    row = _row(model, found, shot, errors)
    # The first frame that is kept need not look along the shot's heading.
    picture = found.pictures[0]
    turned = photograph_heading(picture.query, picture.candidates[0]) - shot.heading - float(turns[0])
    return row._replace(turned=abs(float(wrap_angle(turned))))


def _of_turn(model: LocalModel, shot: Shot, frames: Sequence[Frame], phone: Phone) -> dict[str, _Row]:
    """Return the results for one turn by what is known."""
    plan, height = shot.home.plan, CameraHeight(shot.camera_height_m)
    grid = model.grid(plan, shot.camera_height_m)
    contents = [encode_jpeg(frame.pixels) for frame in frames]
    turns = [float(wrap_angle(frame.heading - frames[0].heading)) for frame in frames]
    rows: dict[str, _Row] = {}
    for name, stated in (
        ("overlap", StatedCamera(projection="perspective", hfov_deg=phone.hfov_deg)),
        ("overlap_unknown_field", StatedCamera(projection="perspective")),
    ):
        photographs, angles = model.open_turn(contents, stated)
        found = model.localise_turn(plan, grid, photographs, LinkedTurn.of(angles), height)
        errors = _angle_errors(photographs, angles, turns, phone)
        rows[name] = _row(model, found, shot, errors)
        if name == "overlap":
            exact = LinkedTurn.of(
                [
                    replace(angle, group=0, heading=turn, heading_sd=0.0)
                    for angle, turn in zip(angles, turns, strict=True)
                ]
            )
            found = model.localise_turn(plan, grid, photographs, exact, height)
            rows["stated"] = _row(model, found, shot, (0.0, 1.0, 0.0))
    return rows


def _angle_errors(
    photographs: Sequence[Photograph], angles: Sequence[TurnAngles], turns: Sequence[float], phone: Phone
) -> tuple[float, float, float]:
    """Return the median error (degrees) of angles in groups, the share of photographs in one, and the field's error."""
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
    return float(np.median(missed)) if missed else math.nan, len(missed) / len(turns), field


def _row(model: LocalModel, found: SequenceLocalisation, shot: Shot, errors: tuple[float, float, float]) -> _Row:
    picture = found.pictures[0]
    answer, confidence = picture.candidates[0], found.confidence(model.bundle.manifest)
    return _Row(
        float(np.linalg.norm(answer.position_m - shot.position_m)),
        abs(float(wrap_angle(photograph_heading(picture.query, answer) - shot.heading))),
        math.nan if confidence is None else confidence,
        *errors,
    )


def _summary(rows: Sequence[_Row]) -> dict[str, float]:
    error_m, turned, confidence, angles_deg, linked, field = np.array(rows).T
    near = error_m < 1.0
    return {
        "n": len(rows),
        "within_1m": float(near.mean()),
        "within_1m_30deg": float((near & (turned < math.radians(30.0))).mean()),
        "median_cm": 100.0 * float(np.median(error_m)),
        "mean_confidence": float(confidence.mean()),
        "expected_calibration_error": expected_calibration_error(confidence, near),
        "median_angle_error_deg": float(np.nanmedian(angles_deg)) if np.isfinite(angles_deg).any() else math.nan,
        "linked_share": float(linked.mean()),
        "median_field_error": float(np.median(field)),
    }
