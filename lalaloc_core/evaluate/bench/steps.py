"""Expected against found confidence after the next step of answers that are not sure."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.evaluate.bench.measured import Setting, means
from lalaloc_core.learn.data.synthetic.generated import RenderedPhotograph
from lalaloc_core.learn.data.views import CachedSphere, ViewPhotograph, tilt_by_hand
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.localise.belief import CONFIDENT, Confidence
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.localisability.next_step import BEHIND_M, HEADING_ERROR, NextStep, next_steps
from lalaloc_core.localise.localisability.reports import known_of
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Hints, Query
from lalaloc_core.localise.search.pipeline import Localisation, localise, run_steps
from lalaloc_core.localise.tracking import Odometry, TrackState
from lalaloc_core.localise.tracking.tracked_plans import TrackedPlans
from lalaloc_core.localise.tracking.tracking_filter import track_steps
from lalaloc_core.photograph import Photograph

_FIELD_DEG, _SHOTS = 80.0, 2
# Standard deviations of the stated way through a door: of its length (m) and its angles (radians).
_WAY_STD_M, _WAY_STD = 0.3, math.radians(5.0)


class _Row(NamedTuple):
    """Confidence before a step, and expected and found after it; whether the place is right before and after."""

    confidence_before: float
    expected_confidence: float
    found_confidence: float
    within_1m_before: bool
    within_1m: bool


def bench_steps(setting: Setting) -> dict[str, Any]:
    """Measure the best step of each kind after photographs of 80° that are not sure, 2 in each furnished test home."""
    rows: defaultdict[str, list[_Row]] = defaultdict(list)
    spent_s: list[float] = []
    for shots, rng in setting.shots(_SHOTS):
        grid = setting.model.grid(shots[0].home.plan, shots[0].camera_height_m)
        for shot in shots:
            visit = _Visit(setting, grid, shot, rng)
            begin_s = time.process_time()
            steps = visit.steps()
            spent_s.append(time.process_time() - begin_s)
            # The best step comes first.
            for kind in dict.fromkeys(step.kind for step in steps):
                row = visit.row(next(step for step in steps if step.kind == kind))
                rows[kind].append(row)
                rows["best"] += [row] if kind == steps[0].kind else []
    report: dict[str, Any] = {name: means(rows[name]) for name in ("best", *sorted(rows.keys() - {"best"}))}
    return report | {"median_cpu_ms": 1e3 * float(np.median(spent_s)), "max_cpu_ms": 1e3 * max(spent_s)}


@dataclass
class _Visit:
    """A photograph of a test home and its answer."""

    setting: Setting
    grid: PoseGrid
    shot: Shot
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.model, self.plan = self.setting.model, self.shot.home.plan
        self.height = CameraHeight(self.shot.camera_height_m)
        self.sphere = self._sphere(self.shot)
        self.photograph = self._view(self.sphere, 0.0)
        self.found = self._localised(self.model.encoder.query(self.photograph, None, self.height))

    def steps(self) -> list[NextStep]:
        """Return the steps that are worth it; none where the answer is sure."""
        confidence = self._confidence(self.found)
        if confidence is None or confidence.position >= CONFIDENT:
            return []
        arcs, field = [self.photograph.azimuths], self.photograph.hfov.value
        known = known_of(self.found, confidence, arcs=arcs, field=field)
        return next_steps(self.plan, self.model.bundle.manifest, known, step_m=self.grid.step_m)

    def row(self, step: NextStep) -> _Row:
        before, first_m = self._outcome(self.found)
        confidence, error_m = getattr(self, f"_after_{step.kind}")(step)
        return _Row(before, step.confidence, confidence, first_m < 1.0, error_m < 1.0)

    def _after_turn(self, step: NextStep) -> tuple[float, float]:
        others = [(self._view(self.sphere, step.turn), step.turn)]
        query = self.model.encoder.query(self.photograph, None, self.height, others=others)
        return self._outcome(self._localised(query))

    def _after_heading(self, step: NextStep) -> tuple[float, float]:
        told = self.shot.heading + float(self.rng.uniform(-HEADING_ERROR, HEADING_ERROR))
        query = self.model.encoder.query(self.photograph, told, self.height, heading_tolerance=HEADING_ERROR)
        return self._outcome(self._localised(query))

    def _after_rooms(self, step: NextStep) -> tuple[float, float]:
        rooms = self.plan.rooms
        name = rooms[self.shot.room_index].name.casefold()
        hints = Hints(rooms=frozenset(index for index, room in enumerate(rooms) if room.name.casefold() == name))
        return self._outcome(self._localised(self.found.query, hints))

    def _after_door(self, step: NextStep) -> tuple[float, float]:
        azimuth, way_m = self.shot.heading + step.turn, step.distance_m + BEHIND_M
        place = self.shot.position_m + way_m * np.array([math.sin(azimuth), math.cos(azimuth)])
        (room,) = self.plan.room_index_at(place[None])
        if room in (-1, self.shot.room_index):
            # There is no such door; nothing is sent.
            return self._outcome(self.found)
        shot = dataclasses.replace(self.shot, position_m=place, room_index=int(room), heading=azimuth)
        forward_m, right_m = way_m * math.cos(step.turn), way_m * math.sin(step.turn)
        motion = Odometry.of_stds(forward_m, right_m, step.turn, (_WAY_STD_M, _WAY_STD_M, _WAY_STD))
        plans, layouts, state = TrackedPlans.of_plan(self.plan, self.grid), self.model.encoder.layouts, None
        for view, odometry in ((self.photograph, None), (self._view(self._sphere(shot), 0.0), motion)):
            query = self.model.encoder.query(view, None, self.height)
            state = state or TrackState.first(len(query.roll))
            found = run_steps(track_steps(plans, layouts, state, query, odometry), self.model.refiner)
            state = found.state
        return found.pose.probability, math.hypot(found.pose.x_m - place[0], found.pose.y_m - place[1])

    def _sphere(self, shot: Shot) -> CachedSphere:
        return CachedSphere(RenderedPhotograph(shot, self.setting.renderers))

    def _view(self, sphere: CachedSphere, azimuth: float) -> Photograph:
        pitch, roll = tilt_by_hand(self.rng)
        view = ViewPhotograph(sphere=sphere, azimuth=azimuth, field_deg=_FIELD_DEG, pitch=pitch, roll=roll)
        return view.open(patch_size(self.model.bundle.manifest))

    def _localised(self, query: Query, hints: Hints = NO_HINTS) -> Localisation:
        layouts, refiner = self.model.encoder.layouts, self.model.refiner
        return localise(self.plan, self.grid, layouts, query, refiner=refiner, hints=hints)

    def _confidence(self, found: Localisation) -> Confidence | None:
        return found.confidence(self.model.bundle.manifest.confidence_for(view=True, turn=found.query.is_turn))

    def _outcome(self, found: Localisation) -> tuple[float, float]:
        confidence = self._confidence(found)
        assert confidence is not None
        return confidence.position, float(np.linalg.norm(found.candidates[0].position_m - self.shot.position_m))
