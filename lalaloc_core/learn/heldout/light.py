"""Light in a home: lamps, windows and the sun with traced shadows, one gathered bounce, and the outdoors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.heldout.furnishing import lamp_place
from lalaloc_core.learn.heldout.procedural_materials import Materials
from lalaloc_core.learn.heldout.tracing import OFFSET_M, Tracer
from lalaloc_core.learn.heldout.wall_holes import Opening


@dataclass(frozen=True, eq=False)
class Sky:
    """The outdoors of one photograph; colours are linear RGB.

    Attributes:
        sunlight: light on a face turned to the sun; zero under clouds or at night.
        waves: (k, 3) frequency, phase and height of the hills' outline.
        blocks: random numbers of the houses' outline.
    """

    zenith: Float[np.ndarray, "3"]
    horizon: Float[np.ndarray, "3"]
    ground: Float[np.ndarray, "3"]
    sun: Float[np.ndarray, "3"]
    sunlight: Float[np.ndarray, "3"]
    waves: Float[np.ndarray, "k 3"]
    blocks: Float[np.ndarray, "m"]

    @classmethod
    def sample(cls, rng: np.random.Generator) -> Sky:
        """Draw a sky: mostly day, clear or covered; sometimes dusk or night."""
        weather = rng.choice(["clear", "covered", "dusk", "night"], p=[0.45, 0.35, 0.1, 0.1])
        height, around = np.radians(rng.uniform(8, 60)), rng.uniform(0, 2 * np.pi)
        sun = np.array([np.cos(height) * np.sin(around), np.cos(height) * np.cos(around), np.sin(height)])
        zenith, horizon, sunlight = {
            "clear": ([0.9, 1.6, 3.2], [2.6, 3.0, 3.4], np.array([14.0, 12.5, 10.0]) * rng.uniform(0.5, 1.2)),
            "covered": ([2.0, 2.1, 2.2], [2.4, 2.4, 2.4], np.zeros(3)),
            "dusk": ([0.25, 0.3, 0.6], [1.6, 0.8, 0.4], np.zeros(3)),
            "night": ([0.01, 0.01, 0.02], [0.05, 0.045, 0.05], np.zeros(3)),
        }[str(weather)]
        bright = rng.uniform(0.5, 1.4)
        waves = np.stack([rng.integers(1, 12, 5), rng.uniform(0, 6.28, 5), rng.uniform(0.005, 0.05, 5)], axis=1)
        ground = np.array(horizon) * rng.uniform(0.1, 0.4) * rng.choice([[0.4, 0.6, 0.25], [0.55, 0.5, 0.45]])
        return cls(
            zenith=np.array(zenith) * bright,
            horizon=np.array(horizon) * bright,
            ground=ground * bright,
            sun=sun,
            sunlight=np.asarray(sunlight),
            waves=waves,
            blocks=rng.random(48),
        )

    def colour(self, direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the radiance along each direction."""
        up = direction[:, 2:]
        azimuth = np.arctan2(direction[:, 0], direction[:, 1])
        sky = self.horizon + (self.zenith - self.horizon) * np.clip(up, 0, 1) ** 0.5
        hills = 0.04 + (self.waves[:, 2] * np.sin(azimuth[:, None] * self.waves[:, 0] + self.waves[:, 1])).sum(axis=1)
        cell = (azimuth / (2 * np.pi) + 0.5) * len(self.blocks)
        house = self.blocks[cell.astype(int) % len(self.blocks)]
        houses = np.where(house > 0.45, 0.25 * (house - 0.35), -1.0)
        colour = np.where(up < np.maximum(hills, 0.01)[:, None], 0.45 * self.ground + 0.3 * self.horizon, sky)
        colour = np.where(
            ((up[:, 0] < houses) & (cell % 1 > 0.15))[:, None], 0.4 * self.horizon * (0.3 + house[:, None]), colour
        )
        return np.where(up < 0.0, self.ground * (1.0 - 0.5 * np.clip(-up, 0, 1)), colour)

    def mean(self) -> Float[np.ndarray, "3"]:
        """Return the mean radiance of a window."""
        return 0.45 * self.horizon + 0.3 * self.zenith + 0.25 * self.ground


_LAMP_DROP_M = 0.75
_LAMP_RADIUS_M = 0.22
_MEAN_REFLECTANCE = 0.6
# Light from nearer than this (m) is attenuated, because one bounce makes corners too bright.
_NEAR_M = 0.25
_MAX_BRIGHTNESS = 2.0


@dataclass(frozen=True, eq=False)
class Lights:
    """All light of one photograph, per room.

    Attributes:
        lamp_m, lamp: place and intensity (linear RGB) of each room's lamp.
        window_m, window_u, window_v: centre and half extents of every window, those of room r from `first[r]` on.
        ambient: light that falls on each room's surfaces after many bounces.
    """

    lamp_m: Float[np.ndarray, "r 3"]
    lamp: Float[np.ndarray, "r 3"]
    window_m: Float[np.ndarray, "w 3"]
    window_u: Float[np.ndarray, "w 3"]
    window_v: Float[np.ndarray, "w 3"]
    inward: Float[np.ndarray, "w 3"]
    first: Int[np.ndarray, "r"]
    count: Int[np.ndarray, "r"]
    ambient: Float[np.ndarray, "r 3"]
    sky: Sky

    @classmethod
    def sample(cls, plan: FloorPlan, openings: Sequence[Opening], sky: Sky, rng: np.random.Generator) -> Lights:
        """Light the rooms: lamps are often off by day, never in rooms without windows."""
        windows = sorted((o for o in openings if o.kind == "window"), key=lambda o: o.wall.room)
        count = np.bincount([o.wall.room for o in windows], minlength=len(plan.rooms))
        bright = float(sky.mean().mean())
        on = (rng.random(len(plan.rooms)) < (0.45 if bright > 0.5 else 0.95)) | (count == 0)
        warmth = rng.uniform(0.0, 1.0)
        tint = np.array([1.0, 0.92 - 0.14 * warmth, 0.86 - 0.45 * warmth])
        area = np.array([room.area_m2 for room in plan.rooms])
        power = rng.uniform(2.0, 6.0) * np.sqrt(area / 12) * rng.uniform(0.6, 1.4, len(area)) * on
        lamp = power[:, None] * tint
        lamp_m = np.array([[*lamp_place(room.shape), room.ceiling_height_m - _LAMP_DROP_M] for room in plan.rooms])
        panes = [_pane(o) for o in windows]
        flux = 4 * np.pi * lamp
        for o, pane in zip(windows, panes, strict=True):
            size = 4 * np.linalg.norm(pane.u) * np.linalg.norm(pane.v)
            facing = max(0.0, float(-pane.inward @ sky.sun))
            flux[o.wall.room] += size * (np.pi * sky.mean() + 0.3 * sky.sunlight * facing)
        heights = plan.ceiling_heights_m
        around = np.array(
            [2 * room.area_m2 + room.shape.length * h for room, h in zip(plan.rooms, heights, strict=True)]
        )
        ambient = flux / around[:, None] * _MEAN_REFLECTANCE / (1 - _MEAN_REFLECTANCE)
        return cls(
            lamp_m=lamp_m,
            lamp=lamp,
            window_m=_rows([pane.centre_m for pane in panes]),
            window_u=_rows([pane.u for pane in panes]),
            window_v=_rows([pane.v for pane in panes]),
            inward=_rows([pane.inward for pane in panes]),
            first=np.cumsum(count) - count,
            count=count,
            ambient=ambient + 0.01,
            sky=sky,
        )

    def soft(
        self,
        tracer: Tracer,
        materials: Materials,
        number: Int[np.ndarray, "f"],
        room: Int[np.ndarray, "n"],
        point_m: Float[np.ndarray, "n 3"],
        normal: Float[np.ndarray, "n 3"],
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "n 3"]:
        """Return the light on each point from lamps, windows and surfaces, with one random ray to each kind.

        `number` is the material of each face of the home's mesh; `room` and the unit `normal` are those of each point.
        """
        start = point_m + OFFSET_M * normal
        return (
            self._from_lamps(tracer, room, start, normal, rng)
            + self._from_windows(tracer, room, start, normal, rng)
            + self._gathered(tracer, materials, number, room, start, normal, rng)
        )

    def sunlight(
        self, tracer: Tracer, point_m: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the sunlight on each point."""
        out = np.zeros_like(point_m, dtype=np.float32)
        slope = normal @ self.sky.sun
        lit = np.flatnonzero(slope > 0.0)
        if self.sky.sunlight.any() and len(lit):
            ray = np.broadcast_to(self.sky.sun, (len(lit), 3))
            free = ~tracer.blocked(point_m[lit] + OFFSET_M * normal[lit], ray, np.full(len(lit), 1e3))
            out[lit] = (slope[lit] * free)[:, None] * self.sky.sunlight
        return out

    def _from_lamps(
        self, tracer: Tracer, room: np.ndarray, start: np.ndarray, normal: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        target = self.lamp_m[room] + _LAMP_RADIUS_M * _on_sphere(len(room), rng)
        ray, distance = _toward(start, target)
        slope = np.sum(ray * normal, axis=1)
        out = np.zeros((len(room), 3), np.float32)
        lit = np.flatnonzero((slope > 0.0) & (self.lamp[room].max(axis=1) > 0.0))
        # Skip the lamp's own shade.
        reach = np.maximum(distance[lit] - 2.2 * _LAMP_RADIUS_M, 1e-3)
        free = ~tracer.blocked(start[lit], ray[lit], reach)
        out[lit] = (slope[lit] * free / np.maximum(distance[lit], 0.4) ** 2)[:, None] * self.lamp[room[lit]]
        return out

    def _from_windows(
        self, tracer: Tracer, room: np.ndarray, start: np.ndarray, normal: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        out = np.zeros((len(room), 3), np.float32)
        some = np.flatnonzero(self.count[room] > 0)
        if len(some) == 0:
            return out
        many = self.count[room[some]]
        chosen = self.first[room[some]] + (rng.random(len(some)) * many).astype(int)
        a, b = rng.uniform(-1, 1, (2, len(some), 1))
        target = self.window_m[chosen] + a * self.window_u[chosen] + b * self.window_v[chosen]
        ray, distance = _toward(start[some], target)
        slope = np.sum(ray * normal[some], axis=1)
        facing = -np.sum(ray * self.inward[chosen], axis=1)
        size = 4 * np.linalg.norm(self.window_u[chosen], axis=1) * np.linalg.norm(self.window_v[chosen], axis=1)
        lit = np.flatnonzero((slope > 0) & (facing > 0))
        free = ~tracer.blocked(start[some[lit]], ray[lit], np.maximum(distance[lit] - 0.02, 1e-3))
        share = many[lit] * size[lit] * slope[lit] * facing[lit] * free / (distance[lit] ** 2 + 0.2)
        out[some[lit]] = share[:, None] * self.sky.mean()
        return out

    def _gathered(
        self,
        tracer: Tracer,
        materials: Materials,
        number: np.ndarray,
        room: np.ndarray,
        start: np.ndarray,
        normal: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        ray = normal + 0.999 * _on_sphere(len(start), rng)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        hits = tracer.first(start, ray)
        # Light from outdoors is counted with the windows.
        met = hits.face >= 0
        ambient = self.ambient[tracer.room[hits.face]] / _MEAN_REFLECTANCE
        distance = np.where(met, hits.distance_m, 0.0)
        light = materials.mean(number[hits.face]) * ambient * (distance / (distance + _NEAR_M))[:, None]
        # Clip, because few bright rays would show as spots.
        return np.minimum(light, _MAX_BRIGHTNESS * self.ambient[room]).astype(np.float32)


class _Pane(NamedTuple):
    """Centre, half extents (vectors) and inward normal of a window."""

    centre_m: Float[np.ndarray, "3"]
    u: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    inward: Float[np.ndarray, "3"]


def _pane(opening: Opening) -> _Pane:
    """Return the pane of a window in the face of its wall."""
    wall = opening.wall
    middle = wall.point_m((opening.left_m + opening.right_m) / 2)
    centre = np.array([*middle, (opening.sill_m + opening.top_m) / 2])
    u = np.array([*wall.along, 0.0]) * (opening.right_m - opening.left_m) / 2
    v = np.array([0.0, 0.0, (opening.top_m - opening.sill_m) / 2])
    return _Pane(centre_m=centre, u=u, v=v, inward=np.array([*-wall.outward, 0.0]))


def _rows(vectors: Sequence[Float[np.ndarray, "3"]]) -> Float[np.ndarray, "w 3"]:
    return np.array(vectors).reshape(-1, 3)


def _toward(start: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ray = target - start
    distance = np.linalg.norm(ray, axis=1)
    return ray / np.maximum(distance, 1e-6)[:, None], distance


def _on_sphere(count: int, rng: np.random.Generator) -> np.ndarray:
    z, a = rng.uniform(-1, 1, count), rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)
