"""Gallery of a report: the best, median and worst queries with pictures, drawn with the run's data set and model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lalaloc_core.draw.heat import Cells
from lalaloc_core.errors import LaLaLocError
from lalaloc_core.evaluate.methods.lalaloc import encode, read_image
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.methods.similarity import ChamferGrid, true_layout
from lalaloc_core.evaluate.report.pictures import (
    SPHERE_HEIGHT,
    SPHERE_WIDTH,
    DrawnMap,
    EncodedPicture,
    draw_map,
    draw_sphere,
)
from lalaloc_core.evaluate.report.reading import Run
from lalaloc_core.evaluate.report.reopening import ReopenedRun
from lalaloc_core.evaluate.runs.failures import Outcome, outcomes
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import heading_errors_deg, position_errors_m
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match.cost_terms import latent_distances

PER_GROUP = 3
BEST, MEDIAN, WORST, MISALIGNED = "best", "median", "worst", "wrong alignment"
# Methods that compare latents.
_LATENT_METHODS = ("lalaloc", "decode")
# Side of the maps' cells, larger in plans with more than the maximum number.
_CELL_M, _MAX_CELLS = 0.2, 5000


@dataclass(frozen=True, eq=False, kw_only=True)
class Card:
    """Query of the gallery; errors are None without an answer."""

    scene: str
    camera: str
    room: str
    found_room: str | None
    outcome: Outcome
    error_m: float | None
    heading_error_deg: float | None
    confidence: float | None
    pictures: tuple[EncodedPicture, ...]

    @property
    def bytes(self) -> int:
        """Size of the pictures."""
        return sum(len(picture.content) for picture in self.pictures)


@dataclass(frozen=True, eq=False, kw_only=True)
class Gallery:
    """Cards by group, in order, and a sentence for each omission."""

    groups: dict[str, list[Card]]
    left_out: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """Size of all pictures."""
        return sum(card.bytes for cards in self.groups.values() for card in cards)


def choose_queries(predictions: list[Prediction]) -> dict[str, list[int]]:
    """Return indices of up to three queries per group, none twice.

    Best and median queries have an answer, the worst may have none. A fourth group has the worst alignments in the
    right room, which are rarely among the worst of all.
    """
    errors_m = position_errors_m(predictions)
    order = [int(index) for index in np.argsort(np.where(np.isnan(errors_m), np.inf, errors_m), kind="stable")]
    answered = [index for index in order if not np.isnan(errors_m[index])]
    middle = max((len(answered) - PER_GROUP) // 2, 0)
    kinds = outcomes(predictions)
    misaligned = [index for index in order if kinds[index] is Outcome.WRONG_ALIGNMENT]
    wanted = {
        BEST: answered[:PER_GROUP],
        WORST: order[::-1][:PER_GROUP],
        MEDIAN: answered[middle : middle + PER_GROUP],
        MISALIGNED: misaligned[::-1][:PER_GROUP],
    }
    taken: set[int] = set()
    chosen = {}
    for group, indices in wanted.items():
        chosen[group] = [index for index in indices if index not in taken]
        taken.update(chosen[group])
    return {group: chosen[group] for group in (BEST, MEDIAN, WORST, MISALIGNED) if chosen[group]}


def build_gallery(run: Run) -> Gallery:
    """Draw the gallery of a run; parts whose data or model is missing are named in `left_out`."""
    left_out: list[str] = []
    try:
        writer = _CardWriter(run, left_out)
    except (LaLaLocError, OSError) as error:
        return Gallery(groups={}, left_out=(f"The gallery is left out, because its data cannot be opened: {error}.",))
    groups: dict[str, list[Card]] = {}
    for group, indices in choose_queries(run.predictions).items():
        for index in indices:
            try:
                groups.setdefault(group, []).append(writer.card(index))
            except (LaLaLocError, OSError) as error:
                left_out.append(f"A query of the gallery is left out: {error}.")
    return Gallery(groups=groups, left_out=tuple(dict.fromkeys(left_out)))


class _CardWriter:
    """Data set and model of a run, opened to draw its queries; missing parts are added to `left_out`."""

    def __init__(self, run: Run, left_out: list[str]) -> None:
        """Open data set and model."""
        self._run, self._reopened, self._left_out = run, ReopenedRun(run.info), left_out
        self._encoders = _open_encoders(self._reopened, left_out)
        self._errors_m = position_errors_m(run.predictions)
        self._heading_errors_deg = heading_errors_deg(run.predictions)
        self._outcomes = outcomes(run.predictions)

    def card(self, index: int) -> Card:
        """Draw one query."""
        prediction = self._run.predictions[index]
        scene, camera = self._reopened.find_camera(prediction)
        question = self._reopened.question(scene, camera)
        pose = prediction.final_pose
        return Card(
            scene=prediction.scene,
            camera=prediction.camera,
            room=prediction.room,
            found_room=None if pose is None else scene.plan.rooms[pose.room_index].name,
            outcome=self._outcomes[index],
            error_m=None if pose is None else float(self._errors_m[index]),
            heading_error_deg=None if pose is None else float(self._heading_errors_deg[index]),
            confidence=prediction.confidence,
            pictures=(
                *self._sphere(scene, camera, prediction),
                *(
                    draw_map(scene.plan, drawn, prediction.truth, pose)
                    for drawn in _maps(question, self._encoders, self._left_out)
                ),
            ),
        )

    def _sphere(self, scene: Scene, camera: Camera, prediction: Prediction) -> list[EncodedPicture]:
        try:
            image = self._reopened.photograph(scene, camera).image(SPHERE_HEIGHT, SPHERE_WIDTH)
        except (LaLaLocError, OSError) as error:
            self._left_out.append(f"A sphere is left out: {error}.")
            return []
        return [draw_sphere(image, scene.plan, camera.camera_height_m, prediction.truth, prediction.final_pose)]


def _open_encoders(run: ReopenedRun, left_out: list[str]) -> PhotographEncoder | None:
    """Return the run's model, or None if the method compares no latents or the model is missing."""
    if run.info.method not in _LATENT_METHODS:
        left_out.append(f"Method “{run.info.method}” compares no latents, so there is no map of latent distances.")
        return None
    try:
        return run.open_model()
    except (LaLaLocError, OSError) as error:
        left_out.append(f"The maps of latent distances are left out, because the model cannot be opened: {error}.")
        return None


def _maps(question: Question, encoders: PhotographEncoder | None, left_out: list[str]) -> list[DrawnMap]:
    """Return maps of the query's distance to every place of the plan: by latent, and by true layout."""
    plan, camera = question.plan, question.camera
    cells = Cells.cover(plan, max(_CELL_M, math.sqrt(plan.area_m2 / _MAX_CELLS)))
    maps = []
    if encoders is not None:
        try:
            query = encode(encoders, question, read_image(encoders, question))
        except (LaLaLocError, OSError) as error:
            left_out.append(f"A map of latent distances is left out: {error}.")
        else:
            heading = np.full(len(cells.poses), query.frame_heading)
            latents, _ = encoders.layouts.poses(plan, cells.poses, heading, camera.camera_height_m)
            # The best heading hypothesis of each place.
            distances = latent_distances(latents, query.latents).min(axis=0)
            maps.append(DrawnMap("latent distance", "latent distance (log scale)", cells, distances))
    layouts = ChamferGrid(plan, cells.poses, camera.camera_height_m)
    distances = layouts.distances(true_layout(question, layouts.columns))
    maps.append(DrawnMap("true layout distance", "Chamfer distance (m, log scale)", cells, distances))
    return maps
