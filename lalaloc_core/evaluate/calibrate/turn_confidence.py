"""Confidence of turns, fitted on turns of a phone in generated validation homes.

Costs are means over all azimuths, and those that are not seen cost nothing: the more a turn shows, the higher its cost
at the right place, and the less a model that was fitted on single views believes it. Turns have a model of their own,
fitted on turns once around and on parts of them, on the same after disturbances, and on turns in other buildings. A
phone is held at arm's length. Its angles have the errors of those that overlap tells, those of a run of photographs the
errors of angles that are assumed by their order, and its field of view the error of an estimated one.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from tqdm import tqdm

from lalaloc_core.bundle import Bundle, write_manifest
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.calibrate.calibration import CalibrationConfig
from lalaloc_core.evaluate.calibrate.parameter_fits import Answers, fit_confidence, validation_figures
from lalaloc_core.evaluate.methods.lalaloc import found_pose
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.altered_homes import office_plan, without_openings
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.data.synthetic.turned import Phone, photographs_of_turn
from lalaloc_core.learn.data.views import encode_jpeg
from lalaloc_core.learn.synth.augmentation import jittered, optics
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import LocaliseConfig, localise
from lalaloc_core.photograph import StatedCamera, open_photograph

_SPLIT = SPLIT_NUMBERS["validation"]
# Phones, and the share of upright ones; their pixels are finer than those that the encoder reads.
_UPRIGHT, _LYING = Phone(width=360, height=480), Phone(width=480, height=360, hfov_deg=67.0)
_UPRIGHT_SHARE = 0.7
# Photographs once around, and the fewest of a part of a turn.
_PHOTOGRAPHS, _FEWEST = 12, 3
# Spots of a home, and standard deviations of the relative headings by overlap and of those that are assumed, and of the
# logarithm of the field of view.
_SPOTS, _ANGLE_SD, _ASSUMED_SD, _FIELD_SD = 2, math.radians(0.5), math.radians(4.0), 0.03
# Ratio of homes to those whose disturbed turns are searched in plans without openings.
_PER_UNOPENED_HOME = 4
# Relative error of the camera height of a disturbed turn.
_LENGTH_ERROR = 0.05
_CONFIG = LocaliseConfig(vdr_candidates=0, every_stage=True)


class _Taken(NamedTuple):
    """Pictures of a turn with their headings (radians) minus that of the shot, and the field of view in use."""

    shot: Shot
    pictures: list[UInt8[np.ndarray, "h w 3"]]
    turns: list[float]
    hfov_deg: float


def calibrate_turns(folder: Path, settings: CalibrationConfig) -> Bundle:
    """Fit the confidence of turns, and store it in the bundle's manifest with its validation figures.

    Turns are localised in their own plans, disturbed, and in plans of other buildings. `homes`, `seed` and `textures`
    are the settings that count.
    """
    bundle = Bundle.open(folder)
    manifest, view = bundle.manifest, bundle.manifest.view
    if view is None:
        raise InvalidInputError(f"model '{manifest.name}' has no encoder of views; leave out --turns")
    model = LocalModel(bundle)
    lists: dict[bool, dict[str, list[Prediction]]] = {is_known: defaultdict(list) for is_known in (True, False)}
    for index in tqdm(range(settings.homes), desc="turns of homes", disable=None, leave=False):
        for is_known, part, prediction in _predictions(model, settings, index):
            lists[is_known][part].append(prediction)
    known, searched = (Answers(**lists[is_known]) for is_known in (True, False))
    homes = len({prediction.scene for prediction in searched.own})
    description = (
        f"{len(searched.own)} turns of {_FEWEST} to {_PHOTOGRAPHS} photographs of 53° and 67° in {homes} generated "
        f"validation homes, with an arm of {_UPRIGHT.arm_m:g} m; confidence besides on the same disturbed, and on "
        f"{len(searched.mismatched)} turns in other buildings"
    )
    metrics = {**manifest.metrics, **validation_figures("turn_validation", description, known, searched)}
    view = replace(view, turn_confidence=fit_confidence(known, searched))
    return write_manifest(bundle.folder, replace(manifest, view=view, metrics=metrics))


def _predictions(
    model: LocalModel, settings: CalibrationConfig, index: int
) -> Iterator[tuple[bool, Literal["own", "disturbed", "mismatched"], Prediction]]:
    """Yield the predictions for the turns of a home: whether the heading is known, and the list that they belong to."""
    scene, other = f"home-{index:05d}", _other_plan(settings, index)
    for number, taken in enumerate(_turns_of_home(settings, index)):
        rng = np.random.default_rng([settings.seed, index, number])
        plan = taken.shot.home.plan
        own, disturbed = _Turn(model, taken), _Turn(model, _disturbed(taken, rng))
        factor = math.exp(rng.normal(0.0, _LENGTH_ERROR))
        worse = without_openings(plan) if index % _PER_UNOPENED_HOME == 0 else plan
        for known in (True, False):
            yield known, "own", own.located(plan, scene, number, known=known)
            yield known, "disturbed", disturbed.located(worse, scene, number, known=known, height_factor=factor)
            yield known, "mismatched", own.located(other, scene, number, known=known)


def _other_plan(settings: CalibrationConfig, index: int) -> FloorPlan:
    """Return the plan of another building: a home, a home without openings, or an office."""
    rng = np.random.default_rng([settings.seed, index])
    if index % 3 == 2:
        return office_plan(rng)
    plan = home_of(_SPLIT, settings.seed, index + 1)[0].plan
    return without_openings(plan) if index % 3 == 1 else plan


def _turns_of_home(settings: CalibrationConfig, index: int) -> Iterator[_Taken]:
    """Yield turns of a home: once around, and a part of one, each of a phone held upright or on its side."""
    home, rng = home_of(_SPLIT, settings.seed, index)
    renderers = split_renderer_cache(_SPLIT, settings.seed, settings.textures)
    for shot in sample_shots(home, _SPOTS, rng):
        phone = _UPRIGHT if rng.random() < _UPRIGHT_SHARE else _LYING
        frames = photographs_of_turn(shot, renderers, phone, _PHOTOGRAPHS, rng)
        turns = [float(wrap_angle(frame.heading - shot.heading)) for frame in frames]
        # Walls of a part of the room are plain: their photographs overlap with no other.
        plain = rng.integers(1, _PHOTOGRAPHS) + np.arange(rng.integers(_PHOTOGRAPHS))
        sd = np.where(np.isin(np.arange(_PHOTOGRAPHS), plain), _ASSUMED_SD, _ANGLE_SD)
        turns = [turns[0], *(turns[1:] + rng.normal(0.0, sd[1:])).tolist()]
        pictures = [frame.pixels for frame in frames]
        hfov_deg = phone.hfov_deg * math.exp(rng.normal(0.0, _FIELD_SD))
        yield _Taken(shot, pictures, turns, hfov_deg)
        step, count = int(rng.integers(1, 4)), int(rng.integers(_FEWEST, 9))
        part = slice(0, min(step * count, _PHOTOGRAPHS), step)
        yield _Taken(shot, pictures[part], turns[part], hfov_deg)


def _disturbed(taken: _Taken, rng: np.random.Generator) -> _Taken:
    """Return a turn with the exposure, blur and compression of real cameras."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    images = optics(jittered(torch.from_numpy(np.stack(taken.pictures)), 1.0, generator), 1.0, generator)
    return taken._replace(pictures=list(images.round().to(torch.uint8).numpy()))


class _Turn:
    """A turn whose photographs were read."""

    def __init__(self, model: LocalModel, taken: _Taken) -> None:
        self._model, self._taken = model, taken
        manifest = model.bundle.manifest
        self._photographs = [
            open_photograph(
                encode_jpeg(picture),
                sphere_size=sphere_size(manifest),
                stated=StatedCamera(projection="perspective", hfov_deg=taken.hfov_deg),
                patch_size=patch_size(manifest),
                # Disturbed renderings of white walls are as pale as paper.
                refuse_drawings=False,
            )
            for picture in taken.pictures
        ]

    def located(
        self, plan: FloorPlan, scene: str, number: int, *, known: bool, height_factor: float = 1.0
    ) -> Prediction:
        """Localise the turn in a plan; the stated camera height is wrong by a factor."""
        model, shot = self._model, self._taken.shot
        height_m = shot.camera_height_m * height_factor
        height_m = min(height_m, float(plan.ceiling_heights_m.min()) - 0.1)
        others = list(zip(self._photographs[1:], self._taken.turns[1:], strict=True))
        query = model.encoder.query(
            self._photographs[0], shot.heading if known else None, CameraHeight(height_m), others=others
        )
        grid: PoseGrid = model.grid(plan, height_m)
        found = localise(plan, grid, model.encoder.layouts, query, refiner=model.refiner, config=_CONFIG)
        stages = {stage: found_pose(found.query, candidate) for stage, candidate in found.best.items()}
        information = found.best[found.stage].information
        return Prediction(
            scene=scene,
            camera=str(number),
            room=shot.home.plan.rooms[shot.room_index].id,
            camera_height_m=shot.camera_height_m,
            truth=Pose.at(shot.position_m, shot.room_index, shot.heading),
            stages=stages,
            signals={stage: dataclasses.asdict(signals) for stage, signals in found.signals.items()},
            information=None if information is None else tuple(map(tuple, information.tolist())),
        )
