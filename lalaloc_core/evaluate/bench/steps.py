"""Expected against found confidence after the next step of answers that are not sure."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.learn.data.synthetic.generated import (
    SPLIT_NUMBERS,
    RenderedPhotograph,
    RendererCache,
    split_renderer_cache,
)
from lalaloc_core.learn.data.views import CachedSphere, ViewPhotograph, tilt_by_hand
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.belief import CONFIDENT, Confidence
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
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
_SPLIT = SPLIT_NUMBERS["test"]
# Standard deviations of the stated way through a door: of its length (m) and its angles (radians).
_WAY_STD_M, _WAY_STD = 0.3, math.radians(5.0)


class _Row(NamedTuple):
    """Confidence before a step, and expected and found after it; whether the place is right before and after."""

    kind: str
    before: float
    expected: float
    found: float
    right_before: bool
    right: bool
    best: bool


def bench_steps(setting: Setting) -> dict[str, Any]:
    """Measure the best step of each kind after photographs of 80° that are not sure, 2 in each furnished test home."""
    model, renderers = setting.model, split_renderer_cache(_SPLIT, 0, setting.textures)
    rows: list[_Row] = []
    spent_s: list[float] = []
    for index in range(setting.homes):
        home, rng = home_of(_SPLIT, 0, index)
        grid = None
        for shot in sample_shots(home, _SHOTS, rng, "full"):
            grid = grid or model.grid(home.plan, shot.camera_height_m)
            visit = _Visit(model, grid, shot, renderers, rng)
            begin_s = time.process_time()
            steps = visit.steps()
            spent_s.append(time.process_time() - begin_s)
            best: dict[str, NextStep] = {}
            for step in steps:
                best.setdefault(step.kind, step)
            rows += [visit.row(step, best=step is steps[0]) for step in best.values()]
    kinds = sorted({row.kind for row in rows})
    report = {"best": _summary([row for row in rows if row.best])}
    report |= {kind: _summary([row for row in rows if row.kind == kind]) for kind in kinds}
    return report | {"median_cpu_ms": 1e3 * float(np.median(spent_s)), "max_cpu_ms": 1e3 * max(spent_s)}


@dataclass
class _Visit:
    """A photograph of a test home and its answer."""

    model: LocalModel
    grid: PoseGrid
    shot: Shot
    renderers: RendererCache
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.height = CameraHeight(self.shot.camera_height_m)
        self.sphere = CachedSphere(RenderedPhotograph(self.shot, self.renderers))
        self.photograph = self._view(self.sphere, 0.0)
        self.found = self._localised(self.model.encoder.query(self.photograph, None, self.height))

    def steps(self) -> list[NextStep]:
        """Return the steps that are worth it; none where the answer is sure."""
        confidence = self._confidence(self.found)
        if confidence is None or confidence.position >= CONFIDENT:
            return []
        arcs, field = [self.photograph.azimuths], self.photograph.hfov.value
        known = known_of(self.found, confidence, arcs=arcs, field=field)
        return next_steps(self.shot.home.plan, self.model.bundle.manifest, known, step_m=self.grid.step_m)

    def row(self, step: NextStep, *, best: bool) -> _Row:
        before = self._confidence(self.found)
        assert before is not None
        confidence, error_m = getattr(self, f"_after_{step.kind}")(step)
        first_m = float(np.linalg.norm(self.found.candidates[0].position_m - self.shot.position_m))
        return _Row(step.kind, before.position, step.confidence, confidence, first_m < 1.0, error_m < 1.0, best)

    def _after_turn(self, step: NextStep) -> tuple[float, float]:
        others = [(self._view(self.sphere, step.turn), step.turn)]
        return self._outcome(
            self._localised(self.model.encoder.query(self.photograph, None, self.height, others=others))
        )

    def _after_heading(self, step: NextStep) -> tuple[float, float]:
        told = self.shot.heading + float(self.rng.uniform(-HEADING_ERROR, HEADING_ERROR))
        query = self.model.encoder.query(self.photograph, told, self.height, heading_tolerance=HEADING_ERROR)
        return self._outcome(self._localised(query))

    def _after_rooms(self, step: NextStep) -> tuple[float, float]:
        rooms = self.shot.home.plan.rooms
        name = rooms[self.shot.room_index].name.casefold()
        hints = Hints(rooms=frozenset(index for index, room in enumerate(rooms) if room.name.casefold() == name))
        return self._outcome(self._localised(self.found.query, hints))

    def _after_door(self, step: NextStep) -> tuple[float, float]:
        plan, azimuth = self.shot.home.plan, self.shot.heading + step.turn
        way_m = step.distance_m + BEHIND_M
        place = self.shot.position_m + way_m * np.array([math.sin(azimuth), math.cos(azimuth)])
        (room,) = plan.room_index_at(place[None])
        if room in (-1, self.shot.room_index):
            # There is no such door; nothing is sent.
            return self._outcome(self.found)
        shot = dataclasses.replace(self.shot, position_m=place, room_index=int(room), heading=azimuth)
        sphere = CachedSphere(RenderedPhotograph(shot, self.renderers))
        forward_m, right_m = way_m * math.cos(step.turn), way_m * math.sin(step.turn)
        motion = Odometry.of_stds(forward_m, right_m, step.turn, (_WAY_STD_M, _WAY_STD_M, _WAY_STD))
        plans, layouts, state = TrackedPlans.of_plan(plan, self.grid), self.model.encoder.layouts, None
        for view, odometry in ((self.photograph, None), (self._view(sphere, 0.0), motion)):
            query = self.model.encoder.query(view, None, self.height)
            state = state or TrackState.first(len(query.roll))
            found = run_steps(track_steps(plans, layouts, state, query, odometry), self.model.refiner)
            state = found.state
        return found.pose.probability, math.hypot(found.pose.x_m - place[0], found.pose.y_m - place[1])

    def _view(self, sphere: CachedSphere, azimuth: float) -> Photograph:
        pitch, roll = tilt_by_hand(self.rng)
        view = ViewPhotograph(sphere=sphere, azimuth=azimuth, field_deg=_FIELD_DEG, pitch=pitch, roll=roll)
        return view.open(patch_size(self.model.bundle.manifest))

    def _localised(self, query: Query, hints: Hints = NO_HINTS) -> Localisation:
        plan = self.shot.home.plan
        return localise(plan, self.grid, self.model.encoder.layouts, query, refiner=self.model.refiner, hints=hints)

    def _confidence(self, found: Localisation) -> Confidence | None:
        return found.confidence(self.model.bundle.manifest.confidence_for(view=True, turn=found.query.is_turn))

    def _outcome(self, found: Localisation) -> tuple[float, float]:
        confidence = self._confidence(found)
        assert confidence is not None
        return confidence.position, float(np.linalg.norm(found.candidates[0].position_m - self.shot.position_m))


def _summary(rows: Sequence[_Row]) -> dict[str, float]:
    if not rows:
        return {"n": 0}
    _, before, expected, found, right_before, right, _ = (np.array(values) for values in zip(*rows, strict=True))
    return {
        "n": len(rows),
        "confidence_before": float(before.mean()),
        "expected_confidence": float(expected.mean()),
        "found_confidence": float(found.mean()),
        "within_1m_before": float(right_before.mean()),
        "within_1m": float(right.mean()),
    }
