"""Photographs: four rays per pixel and the response of a film."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import column_azimuths, row_elevations
from lalaloc_core.learn.heldout.furnishing import Level
from lalaloc_core.learn.heldout.homes import HomeKey, Stand, TracedHome, traced_home
from lalaloc_core.learn.heldout.light import Lights, Sky
from lalaloc_core.learn.heldout.tracing import OFFSET_M

_GLOW = 4.0
# Neighbours of a pixel for smoothing: a disc of radius 2.
_NEIGHBOURS = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if 0 < i * i + j * j <= 5]


@dataclass(frozen=True, eq=False)
class HeldoutShot:
    """One photograph: home, furniture level, camera, and the seed of its light and noise."""

    key: HomeKey
    furniture: Level
    stand: Stand
    number: int


def render(shot: HeldoutShot, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Render the photograph at a size."""
    rng = shot.key.rng(4, shot.number)
    traced = traced_home(shot.key, shot.furniture)
    plan = traced.home.plan.plan
    lights = Lights.sample(plan, traced.home.openings, Sky.sample(rng), rng)
    film = _Film.sample(rng)
    light = _radiance(traced, lights, shot.stand, height, width, rng)
    return film.develop(light, rng)


def depth_m(shot: HeldoutShot, height: int, width: int) -> Float[np.ndarray, "{height} {width}"]:
    """Return the distance (m) along each pixel's ray; NaN for the sky."""
    rays = _rays(shot.stand, height, width)
    hits = traced_home(shot.key, shot.furniture).tracer.first(_eye(shot.stand, len(rays)), rays)
    return np.where(hits.face < 0, np.nan, hits.distance_m).reshape(height, width)


def _eye(stand: Stand, count: int) -> np.ndarray:
    return np.broadcast_to(np.array([*stand.position_m, stand.camera_height_m]), (count, 3))


def _rays(stand: Stand, height: int, width: int) -> Float[np.ndarray, "n 3"]:
    """Return unit directions of all pixels, row by row."""
    azimuth, elevation = stand.heading + column_azimuths(width)[None, :], row_elevations(height)[:, None]
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), (height, width))
    return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), up], axis=-1).reshape(-1, 3)


def _radiance(
    traced: TracedHome, lights: Lights, stand: Stand, height: int, width: int, rng: np.random.Generator
) -> Float[np.ndarray, "{height} {width} 3"]:
    """Return linear radiance of every pixel: colour from four rays, soft light from two of them."""
    tracer, materials = traced.tracer, traced.materials
    rays = _rays(stand, 2 * height, 2 * width)
    eye = _eye(stand, len(rays))
    hits = tracer.first(eye, rays)
    met = hits.face >= 0
    point = (eye + np.where(met, hits.distance_m, 1.0)[:, None] * rays).astype(np.float32)
    normal = tracer.normals(hits, rays).astype(np.float32)
    number = np.where(met, traced.number[hits.face], 0)
    colour = materials.colour(number, point, normal)
    pixels = np.arange(4 * height * width).reshape(height, 2, width, 2)
    soft, sun = np.zeros((2, height, width, 3), np.float32), np.zeros((2, height, width, 3), np.float32)
    for k in (0, 1):
        chosen = pixels[:, k, :, k].ravel()
        room = tracer.room[hits.face[chosen]]
        lit = lights.soft(tracer, materials, traced.number, room, point[chosen], normal[chosen], rng)
        soft[k] = lit.reshape(height, width, 3)
        sun[k] = lights.sunlight(tracer, point[chosen], normal[chosen]).reshape(height, width, 3)
    corner = pixels[:, 0, :, 0]
    falling = _smoothed(soft.mean(axis=0), point[corner], normal[corner]) + sun.mean(axis=0)
    light = colour.reshape(height, 2, width, 2, 3) * falling[:, None, :, None] / np.pi
    lamp = lights.lamp / np.maximum(lights.lamp.max(axis=1, keepdims=True), 1e-6)
    glow = (materials.glow[number] * met)[:, None] * _GLOW * lamp[tracer.room[hits.face]]
    light += glow.reshape(light.shape)
    flat = light.reshape(-1, 3)
    flat[~met] = lights.sky.colour(rays[~met])
    chosen = corner.ravel()
    number = np.where(met[chosen], number[chosen], -1)
    light = light.mean(axis=(1, 3))
    return _reflected(traced, lights, light, number, rays[chosen], point[chosen], normal[chosen])


def _reflected(
    traced: TracedHome,
    lights: Lights,
    light: np.ndarray,
    number: np.ndarray,
    ray: np.ndarray,
    point: np.ndarray,
    normal: np.ndarray,
) -> np.ndarray:
    """Return reflections in mirrors and polished floors, stronger at grazing angles; `number` is -1 for the sky."""
    tracer, materials = traced.tracer, traced.materials
    gloss = np.where(number < 0, 0.0, materials.gloss[number])
    shiny = np.flatnonzero(gloss > 0.0)
    if len(shiny) == 0:
        return light
    slope = np.abs(np.sum(ray[shiny] * normal[shiny], axis=1))
    share = gloss[shiny] + (1 - gloss[shiny]) * 0.5 * (1 - slope) ** 5
    mirrored = ray[shiny] + 2 * slope[:, None] * normal[shiny]
    start = point[shiny] + OFFSET_M * normal[shiny]
    seen = tracer.first(start, mirrored)
    met = seen.face >= 0
    there = start + np.where(met, seen.distance_m, 1.0)[:, None] * mirrored
    image_number, room = traced.number[seen.face], tracer.room[seen.face]
    facing = tracer.normals(seen, mirrored)
    image = materials.colour(image_number, there, facing) * lights.ambient[room] * (1.3 / np.pi)
    image = image + (materials.glow[image_number] * lights.lamp[room].max(axis=1).clip(0, _GLOW))[:, None]
    image[~met] = lights.sky.colour(mirrored[~met])
    flat = light.reshape(-1, 3)
    flat[shiny] = flat[shiny] * (1 - share[:, None]) + image * share[:, None]
    return flat.reshape(light.shape)


def _smoothed(
    light: Float[np.ndarray, "h w 3"], point_m: Float[np.ndarray, "h w 3"], normal: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Average light over coplanar neighbours to remove the noise of few rays."""
    for stride in (1, 3):
        total, weight = light.copy(), np.ones((*light.shape[:2], 1), np.float32)
        for i, j in _NEIGHBOURS:
            move = (i * stride, j * stride)
            step = np.roll(point_m, move, axis=(0, 1)) - point_m
            same = _dot(normal, np.roll(normal, move, axis=(0, 1))) > 0.9
            same &= np.abs(_dot(normal, step)) < 0.04
            share = same[:, :, None].astype(np.float32)
            total += share * np.roll(light, move, axis=(0, 1))
            weight += share
        light = total / weight
    return light


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


@dataclass(frozen=True, kw_only=True)
class _Film:
    """Response of a camera to light.

    Attributes:
        stops: over- or under-exposure.
        balance: how much of the light's tint is taken out.
        grain: noise of mid-grey, of 1.
        nadir_rows: share of the picture's height, from below, that the tripod hides.
    """

    stops: float
    balance: float
    grain: float
    nadir_rows: float
    nadir: float

    @classmethod
    def sample(cls, rng: np.random.Generator) -> _Film:
        return cls(
            stops=float(rng.normal(0.0, 0.45)),
            balance=float(rng.uniform(0.4, 0.95)),
            grain=float(rng.uniform(0.002, 0.022)),
            nadir_rows=float(rng.uniform(0.04, 0.11)) if rng.random() < 0.4 else 0.0,
            nadir=float(rng.choice([0.02, 0.15, 0.5])),
        )

    def develop(self, light: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
        """Convert linear light to bytes: exposure, balance, a filmic curve, and grain that grows in the dark."""
        height = len(light)
        middle = light[height // 5 : -height // 5].reshape(-1, 3)
        tint = np.exp(np.log(middle + 1e-3).mean(axis=0))
        light = light / (tint / tint.mean()) ** self.balance
        light = light * (0.3 * 2.0**self.stops / tint.mean())
        # Narkowicz's fit of the ACES curve.
        film = np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0.0, 1.0)
        picture = np.where(film < 0.0031308, 12.92 * film, 1.055 * np.maximum(film, 1e-6) ** (1 / 2.4) - 0.055)
        hidden = round(self.nadir_rows * height)
        if hidden:
            picture[-hidden:] = self.nadir
        brightness = picture.mean(axis=2, keepdims=True)
        grey, coloured = rng.normal(size=picture.shape[:2])[:, :, None], rng.normal(size=picture.shape)
        picture = picture + self.grain * (1.4 - brightness) * (0.8 * grey + 0.5 * coloured)
        return (np.clip(picture, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
