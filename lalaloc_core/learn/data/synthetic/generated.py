"""Scenes of the generator, without touching disk: homes by seed, rendered on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene, Split
from lalaloc_core.learn.synth.furniture.furnish import opening_ends_m
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.homes.plans import TEST, TRAIN, VALIDATION, home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer, Window
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.materials import CATEGORIES, PICTURE_SIZE, MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import Fact, Sun
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots

_DEPTH_HEIGHT = 256
_PHOTOGRAPH_RAYS = (2, 2)
SPLIT_NUMBERS: dict[Split, int] = {"train": TRAIN, "validation": VALIDATION, "test": TEST}


@dataclass(frozen=True, kw_only=True)
class GeneratedScenes:
    """Homes of the generator, with cameras 1.0 to 1.9 m high; `furniture` None draws a level for each, unstated."""

    homes: int
    shots_per_home: int = 4
    seed: int = 0
    furniture: Literal["empty", "simple", "full"] | None = "full"
    textures: Path | None = None

    @property
    def appearances(self) -> Sequence[Appearance]:
        """The only appearance, with the configured furniture level."""
        return (Appearance(self.furniture),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes."""
        return [f"{split}-{index:05d}" for index in range(self.homes)]

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"generated homes (seed {self.seed})"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene from its name."""
        split, _, index = name.partition("-")
        number = next((n for known, n in SPLIT_NUMBERS.items() if known == split), None)
        if number is None or not index.isdecimal():
            raise DatasetError("unknown generated scene; names have the form 'test-00042'", scene=name)
        home, rng = home_of(number, self.seed, int(index))
        renderers = split_renderer_cache(number, self.seed, self.textures)
        shots = sample_shots(home, self.shots_per_home, rng, self.furniture)
        cameras = tuple(
            Camera(
                name=str(k),
                position_m=shot.position_m,
                room_index=shot.room_index,
                heading=shot.heading,
                camera_height_m=shot.camera_height_m,
                photographs={self.appearances[0]: RenderedPhotograph(shot, renderers)},
            )
            for k, shot in enumerate(shots)
        )
        return Scene(name=name, plan=home.plan, cameras=cameras)


def training_plans(homes: int, seed: int) -> list[FloorPlan]:
    """Return the plans of the first training homes."""
    return [home_of(TRAIN, seed, index)[0].plan for index in range(homes)]


def camera_seed(camera: Camera) -> int:
    """Derive a seed for a camera's photograph from its position."""
    return int(1e3 * abs(camera.position_m).sum())


class RendererCache:
    """Materials of a split and its renderers by picture size, cached because each takes a second to build."""

    def __init__(self, materials: MaterialLibrary, device: torch.device | str = "cpu") -> None:
        self.materials = materials
        self._device = device
        self._renderers: dict[tuple[int, int, tuple[int, int], Window | None], SphereRenderer] = {}

    def renderer(
        self, height: int, width: int, supersample: tuple[int, int] = (1, 1), window: Window | None = None
    ) -> SphereRenderer:
        """Return the renderer of a picture size with `supersample` rays per pixel along (rows, columns)."""
        key = height, width, supersample, window
        if key not in self._renderers:
            self._renderers[key] = SphereRenderer(
                self.materials, height=height, width=width, device=self._device, supersample=supersample, window=window
            )
        return self._renderers[key]

    def part_of_sphere(self, shot: Shot, window: Window, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
        """Return a sphere of which only a window is rendered, (rows, columns) in `size`; the rest is grey."""
        rows, columns = size
        seen = self.renderer(rows, columns, (1, 1), window).render([shot])[0].cpu().numpy()
        width = round(columns * TWO_PI / window.width)
        sphere = np.full((width // 2, width, 3), 127, np.uint8)
        top, left = round((0.5 - window.top / np.pi) * (width // 2)), (width - columns) // 2
        sphere[top : top + rows, left : left + columns] = seen
        return sphere


@lru_cache(maxsize=4)
def split_renderer_cache(split: int, seed: int, textures: Path | None) -> RendererCache:
    """Return the renderers of a split, each with its own sample of materials."""
    return RendererCache(MaterialLibrary.create(np.random.default_rng([split, seed]), textures))


@dataclass(frozen=True, eq=False)
class RenderedPhotograph:
    """Photograph rendered on demand; like a real one it averages over each pixel's area."""

    shot: Shot
    renderers: RendererCache

    @cached_property
    def facts(self) -> frozenset[str]:
        """Facts that make the shot hard, see `facts_of`."""
        return facts_of(self.shot)

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Render RGB pixels at the given size."""
        return self.renderers.renderer(height, width, _PHOTOGRAPH_RAYS).render([self.shot])[0].cpu().numpy()

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Render the distance (m) along each pixel's ray."""
        return self.renderers.renderer(_DEPTH_HEIGHT, 2 * _DEPTH_HEIGHT).depth_m([self.shot])[0].cpu().numpy()


_WIDE_M = 1.2
_STUB_M = (0.08, 0.65)
_CORRIDOR_WIDTH_M, _CORRIDOR_LENGTH_M = 1.5, 2.5
_CLOSET_M2, _LARGE_M2 = 3.0, 30.0
_NEAR_M, _THRESHOLD_M = 0.4, 0.6
_SUN_SAMPLES = 5


def facts_of(shot: Shot) -> frozenset[Fact]:
    """Return the facts about the room, the camera and the picture of a shot.

    `open_door`, `wide_opening` (from 1.2 m) and `wall_stub` (rest of a wall beside an opening), `corridor` (up to 1.5 m
    wide), `closet` (below 3 m²) and `large_room` (above 30 m²) describe the own room; `near_wall` (below 0.4 m) and
    `threshold` (below 0.6 m from an open door or wide opening) the camera; `counter`, `mirror`, `sun_patch` (visible),
    `nadir_patch` and `bare_bright` (unfurnished, in daylight) the picture.
    """
    # Facts do not depend on the pictures of materials.
    scene = build_scene(shot, _blank_materials())
    room, here = shot.home.plan.rooms[shot.room_index], shapely.Point(shot.position_m)
    own = [opening for opening in shot.home.openings if opening.room == shot.room_index]
    see_through = [opening for opening in own if opening.is_see_through]
    wide = [
        opening for opening in see_through if opening.kind == "opening" and opening.end_m - opening.start_m >= _WIDE_M
    ]
    segments = [shapely.LineString(opening_ends_m(room, opening)) for opening in see_through]
    inscribed_m = 2.0 * shapely.maximum_inscribed_circle(room.shape, 0.02).length
    holds: dict[Fact, bool] = {
        "open_door": any(opening.kind == "door_open" for opening in see_through),
        "wide_opening": bool(wide),
        "wall_stub": any(_has_stub(shot, opening) for opening in wide),
        "corridor": inscribed_m <= _CORRIDOR_WIDTH_M and 0.5 * room.shape.length - inscribed_m >= _CORRIDOR_LENGTH_M,
        "closet": room.area_m2 < _CLOSET_M2,
        "large_room": room.area_m2 > _LARGE_M2,
        "near_wall": room.shape.exterior.distance(here) < _NEAR_M,
        "threshold": any(segment.distance(here) < _THRESHOLD_M for segment in segments),
        "nadir_patch": bool(scene.exposure.nadir > 0.0),
        "sun_patch": _sees_sun(shot, scene.sun),
    }
    held: set[Fact] = {fact for fact, true in holds.items() if true}
    return scene.facts | held


def _has_stub(shot: Shot, opening: Opening) -> bool:
    x0, y0, x1, y1 = shot.home.plan.rooms[opening.room].walls_m[opening.wall]
    rest = (opening.start_m, float(np.hypot(x1 - x0, y1 - y0)) - opening.end_m)
    return any(_STUB_M[0] <= left <= _STUB_M[1] for left in rest)


def _sees_sun(shot: Shot, sun: Sun) -> bool:
    """Return true if some sunlight of the window lands in view of the camera, ignoring furniture."""
    if not sun.colour.any():
        return False
    room = shot.home.plan.rooms[shot.room_index].shape
    inner, camera = room.buffer(-1e-3), shapely.Point(shot.position_m)
    middle = (np.arange(_SUN_SAMPLES) + 0.5) / _SUN_SAMPLES
    toward, rise = sun.direction[:2], sun.direction[2]
    for s in sun.s0_m + middle * (sun.s1_m - sun.s0_m):
        foot = sun.wall_start_m + shot.position_m + sun.wall_along * s
        for z in sun.z0_m + middle * (sun.z1_m - sun.z0_m):
            landing = _end_inside(room, foot, foot - toward * (z / rise))
            if inner.buffer(2e-3).covers(shapely.LineString([camera, landing])):
                return True
    return False


def _end_inside(room: shapely.Polygon, start: np.ndarray, end: np.ndarray) -> shapely.Point:
    """Return the end of a segment that starts on a wall, or the point where it leaves the room before."""
    along = end - start
    inside = room.intersection(shapely.LineString([start + 1e-3 * along, end]))
    parts: Sequence[shapely.Geometry] = [part for part in shapely.get_parts(inside) if part.length > 0.0]
    nearest = min(parts, key=lambda part: part.distance(shapely.Point(start)), default=None)
    return shapely.Point(start if nearest is None else shapely.get_coordinates(nearest)[-1])


@lru_cache(maxsize=1)
def _blank_materials() -> MaterialLibrary:
    """Return a library with one grey picture for everything."""
    grey = torch.full((1, PICTURE_SIZE, PICTURE_SIZE, 3), 0.5)
    first = np.zeros(1, dtype=np.int64)
    return MaterialLibrary(grey, dict.fromkeys(CATEGORIES, first), dict.fromkeys(CATEGORIES, ()), first)
