"""Endless streams of training batches, built in worker processes while the network trains.

A replay buffer uses spheres several times, because rendering one costs as much as a training step on it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, WALL_CODE
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.learn.training.batches import (
    Batch,
    LoadFailure,
    Rotation,
    Stream,
    draw_visits,
    sample_heading,
    sample_rotation,
    stack_rows,
    worker_share,
)
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.deferred import DeferredBatch, DeferredBatcher, DeferredRow, DeferredScene, Row
from lalaloc_core.learn.training.sources import Group, Source, SphereSample, group_around
from lalaloc_core.render.sweep import faces_met, profiles_at

T = TypeVar("T")


class ReplayBuffer(Generic[T]):
    """Buffer that returns every item `uses` times in total, with repeats far apart.

    New items are used immediately. Repeats start when the buffer is filled; from then on every new item comes with
    `uses - 1` random repeats, and the buffer holds about `limit` items, never more. With `uses` 1 it stores nothing.
    """

    def __init__(self, uses: int, limit: int) -> None:
        self._uses = uses
        self._limit = max(limit, 1)
        # Items used once, twice and so on become equally frequent, with `uses / 2` uses left on average instead of the
        # initial `uses - 1`. Starting the repeats below the limit makes the number of items settle at the limit.
        self._enough = max(int(self._limit * uses / (2 * (uses - 1))), 1) if uses > 1 else 0
        self._begun = False
        self._waiting: list[tuple[T, int]] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def add_and_sample(self, new: T, rng: np.random.Generator) -> list[T]:
        """Return the items to use now: `new` and its repeats."""
        if self._uses == 1:
            return [new]
        self._begun |= len(self._waiting) >= self._enough
        repeated = [self._draw(rng) for _ in range(self._uses - 1)] if self._begun and self._waiting else []
        while len(self._waiting) >= self._limit:
            repeated.append(self._draw(rng))
        self._waiting.append((new, self._uses - 1))
        return [new, *repeated]

    def _draw(self, rng: np.random.Generator) -> T:
        index = int(rng.integers(len(self._waiting)))
        value, left = self._waiting[index]
        if left > 1:
            self._waiting[index] = (value, left - 1)
        else:
            self._waiting[index] = self._waiting[-1]
            self._waiting.pop()
        return value


# Code of an unknown class; losses ignore it.
UNKNOWN = -1

_Packed = TypeVar("_Packed")


@dataclass
class LayoutBatches(Stream):
    """Stage 1: stream of layout triplets.

    Each batch holds `profile_m` (anchors, 1 + neighbours, columns) with the anchor first, `camera_height_m` and
    `ceiling_height_m` of the same leading shape.
    """

    config: TrainConfig
    source: Source
    first: int = 0

    def __iter__(self) -> Iterator[Batch | LoadFailure]:
        size = self.config.layout.homes_per_step * self.config.layout.anchors_per_home
        return _batches(self._visit, stack_rows, self.source, size, self.first)

    def _visit(self, visit: int) -> list[Row] | None:
        rng = self.source.rng(visit)
        return [self._row(group, rng) for group in self.source.groups(visit)] or None

    def _row(self, group: Group, rng: np.random.Generator) -> Row:
        stage, turns = self.config.layout, self.config.turns
        size = len(group.position_m)
        # A common heading rotates the whole plan; some negatives are positions of positives at another heading.
        chosen, heading = np.arange(size), np.full(size, sample_heading(turns, rng))
        turned = int(stage.turned_share * stage.triplets.negatives)
        if turned:
            chosen[size - turned :] = rng.integers(0, 1 + stage.triplets.positives, turned)
            heading[size - turned :] = [sample_heading(turns, rng) for _ in range(turned)]
        room = group.room_index[chosen]
        profile = profiles_at(
            group.plan, group.position_m[chosen], room, heading, self.config.profile_columns, np.float32
        )
        if turns != "none" and rng.random() < 0.5:
            profile = profile[:, ::-1].copy()
        return {
            "profile_m": profile,
            "camera_height_m": np.full(size, group.camera_height_m, dtype=np.float32),
            "ceiling_height_m": group.plan.ceiling_heights_m[room].astype(np.float32),
        }


@dataclass
class SphereBatches(Stream):
    """Stage 2: stream of spheres with their layouts, rotated and mirrored together.

    Each batch holds `image` (b, h, w, 3) uint8, `profile_m` (b, columns), `camera_height_m` (b) with the configured
    error, and `ceiling_height_m` (b); renderings have a fourth channel, 255 where a wall is seen. Batches with
    neighbours hold `neighbour_profile_m` (b, n, columns) and `neighbour_ceiling_height_m` (b, n), rotated and mirrored
    like their sphere. With architecture `trunk` there are `opening_kind` (b, columns) and `room_type` (b): codes of
    `conventions`, or `UNKNOWN`, and `edges` (b, columns, 2), see `seen_openings`. Sources with deferred rendering yield
    `DeferredBatch` instead. Views, a part of the horizon, are mirrored only.
    """

    config: TrainConfig
    source: Source
    neighbours: bool = False
    first: int = 0
    views: bool = False

    def __iter__(self) -> Iterator[Batch | DeferredBatch | LoadFailure]:
        stage, (_, workers) = self.config.image, worker_share()
        replay: ReplayBuffer[SphereSample] = ReplayBuffer(stage.uses_per_sphere, stage.replay_spheres // workers)
        batcher = DeferredBatcher(stage.uses_per_sphere)

        def rendered(visit: int) -> list[Row] | None:
            drawn = self._draw(visit, replay)
            return [
                row | {"image": turn.picture(sample.image)}
                for sample, turn, row in drawn
                if row is not None and isinstance(sample.image, np.ndarray)
            ] or None

        def deferred(visit: int) -> list[DeferredRow] | None:
            rows = []
            for sample, turn, row in self._draw(visit, replay):
                assert isinstance(sample.image, DeferredScene)
                if row is None:
                    batcher.use(sample.image)
                else:
                    rows.append((sample.image, turn, row))
            return rows or None

        if self.source.deferred:
            return _batches(deferred, batcher.pack, self.source, stage.batch, self.first)
        return _batches(rendered, stack_rows, self.source, stage.batch, self.first)

    def _draw(self, visit: int, replay: ReplayBuffer[SphereSample]) -> list[tuple[SphereSample, Rotation, Row | None]]:
        """Draw the samples of a visit, their rotations and the rest of their rows; a row without neighbours is None."""
        rng = self.source.rng(visit)
        drawn = []
        sizes = self.config.view if self.views else self.config.image_sizes
        for new in self.source.samples(visit, sizes.image_height, sizes.image_width):
            for sample in replay.add_and_sample(new, rng):
                if self.views:
                    turn = Rotation(shift=0, heading=sample.camera.heading, mirrored=bool(rng.random() < 0.5))
                else:
                    turn = sample_rotation(self.config.turns, sample.camera.heading, sizes.image_width, rng)
                drawn.append((sample, turn, self._row(sample, turn, rng)))
        return drawn

    def _row(self, sample: SphereSample, turn: Rotation, rng: np.random.Generator) -> Row | None:
        position, room = sample.camera.position_m[None], np.array([sample.camera.room_index])
        if self.neighbours:
            group = group_around(sample.camera, sample.plan, self.config.layout.triplets, rng)
            if group is None:
                return None
            position, room = group.position_m, group.room_index
        heading = np.full(len(position), turn.heading)
        columns = self.config.profile_columns
        profile = turn.profile(profiles_at(sample.plan, position, room, heading, columns, np.float32))
        ceiling = sample.plan.ceiling_heights_m[room].astype(np.float32)
        row = {
            "profile_m": profile[0],
            "camera_height_m": np.float32(sample.camera.camera_height_m + self._height_error_m(rng)),
            "ceiling_height_m": ceiling[0],
        }
        if self.config.architecture == "trunk":
            row |= self._classes(sample, turn)
        if self.neighbours:
            row |= {"neighbour_profile_m": profile[1:], "neighbour_ceiling_height_m": ceiling[1:]}
        return row

    def _classes(self, sample: SphereSample, turn: Rotation) -> Row:
        room = sample.plan.rooms[sample.camera.room_index]
        kind, edges = seen_openings(sample.plan, sample.camera, turn.heading, self.config.profile_columns)
        type_code = ROOM_TYPES.index(room.type)
        # Code 0 stands for rooms without a type in the plan.
        return {
            "opening_kind": turn.profile(kind),
            "edges": turn.profile(edges).T,
            "room_type": np.array(type_code or UNKNOWN),
        }

    def _height_error_m(self, rng: np.random.Generator) -> float:
        spread = self.config.image.camera_height_error_m
        return float(np.clip(rng.normal(0.0, spread), -3.0 * spread, 3.0 * spread)) if spread else 0.0


def seen_openings(
    plan: FloorPlan, camera: Camera | Shot, heading: float, columns: int
) -> tuple[Int[np.ndarray, "{columns}"], Float[np.ndarray, "2 {columns}"]]:
    """Return the code seen at each azimuth at eye height, and the elevations (radians) of both edges of openings.

    Walls are `UNKNOWN` in a plan that may lack openings; elevations are NaN at walls and where heights are unknown.
    """
    walls, place = plan.wall_table, (camera.position_m[None], np.array([heading]), np.array([camera.room_index]))
    distance_m, face = (of_pose[0] for of_pose in faces_met(*place, walls, columns, camera.camera_height_m))
    # Rays that meet no opening have the index -1, so the last value is that of walls.
    kind = np.append(walls.opening_kind, WALL_CODE).astype(np.int64)[face]
    if not plan.opening_kinds.issuperset(OPENING_CLASSES[1:]):
        kind[kind == WALL_CODE] = UNKNOWN
    height_m = np.stack([np.append(values, np.nan)[face] for values in (walls.sill_m, walls.head_m)])
    edges = np.arctan2(np.where(np.isfinite(height_m), height_m, np.nan) - camera.camera_height_m, distance_m)
    return kind, edges.astype(np.float32)


def _batches(
    visit: Callable[[int], list[T] | None], pack: Callable[[list[T]], _Packed], source: Source, size: int, first: int
) -> Iterator[_Packed | LoadFailure]:
    """Yield batches of `size` rows from the visits from number `first` on, and load failures in between."""
    rows: list[T] = []
    try:
        for drawn in draw_visits(visit, first, source.patience):
            rows += drawn
            if len(rows) >= size:
                yield from _failures(source)
                yield pack(rows[:size])
                rows = rows[size:]
    except DatasetError as error:
        yield from _failures(source)
        yield LoadFailure(error, fatal=True)


def _failures(source: Source) -> Iterator[LoadFailure]:
    yield from [LoadFailure(error, fatal=False) for error in source.problems]
    source.problems.clear()
