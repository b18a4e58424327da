"""Random light of a scene."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import Prism, wall_frame
from lalaloc_core.learn.synth.furniture.pieces import Finish
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.records import Row
from lalaloc_core.learn.synth.scene.render_scene import Backdrop, Lights, RenderScene, Sun

Mood = Literal["cold", "raw", "warm"]
MOODS: tuple[Mood, ...] = get_args(Mood)

_MAX_WINDOWS = 2
_DOWNLIGHTS, _MAX_DOWNLIGHTS = 4, 10
# The sun falls through the panes, not through the frame.
_FRAME_M = 0.06
# Lamps are no piece of furniture.
_NO_PIECE = -2

# Factors of each mood on the neutral light of lamps and of the sky.
_LAMP_TINTS: dict[Mood, tuple[float, float, float]] = {
    "cold": (0.62, 0.85, 1.15),
    "raw": (1.0, 1.0, 1.0),
    "warm": (1.5, 0.96, 0.45),
}
_SKY_TINTS: dict[Mood, tuple[float, float, float]] = {
    "cold": (1.0, 1.25, 1.6),
    "raw": (1.0, 1.0, 1.0),
    "warm": (0.7, 0.52, 0.36),
}


class Lighting:
    """Mood shared by all lights of a scene: daylight or evening, warm or cold lamps.

    `neutral` lamps are on and nearly white, for a scene that `relit` changes later; `bright` is strong daylight
    reflected by pale walls.
    """

    def __init__(self, rng: np.random.Generator, *, neutral: bool = False, bright: bool = False) -> None:
        self.rng, self._bright = rng, bright
        self.lamp_colour = np.array([1.0, rng.uniform(0.75, 1.0), rng.uniform(0.45, 1.0)])
        self.sky_colour = np.array([rng.uniform(0.85, 1.05), 1.0, rng.uniform(0.95, 1.2)])
        self.daylight = float(rng.uniform(0.4, 3.0) if rng.random() < 0.85 else 0.0)
        self.lamps_on = bool(rng.random() < 0.65 or self.daylight == 0.0)
        self.ambient = math.exp(rng.uniform(math.log(0.12), math.log(0.7)))
        if neutral:
            self.lamp_colour, self.sky_colour = self.lamp_colour**0.2, self.sky_colour**0.4
            self.lamps_on = True
        if bright:
            self.daylight, self.lamps_on = float(rng.uniform(1.2, 4.0)), bool(rng.random() < 0.4)
            self.ambient = math.exp(rng.uniform(math.log(0.4), math.log(1.1)))

    def of_room_beyond(self, room: Room, origin_m: np.ndarray) -> dict[str, Float[np.ndarray, "3"]]:
        """Return the columns of `VisibleRooms` about the one lamp of a neighbouring room, and its ambient light."""
        rng = self.rng
        centre = np.array(room.shape.representative_point().coords[0]) - origin_m
        strength = math.exp(rng.uniform(math.log(0.1), math.log(3.5)))
        tint = self.lamp_colour if rng.random() < 0.5 else self.sky_colour
        # The next room can be dark or very bright.
        low, high = (-0.7, 0.6) if self._bright else (-2.4, 1.1)
        ambient = self.ambient * math.exp(rng.uniform(low, high)) * (0.5 + 0.5 * tint)
        light_m = np.append(centre, room.ceiling_height_m - 0.3)
        return {"light_m": light_m, "light_colour": strength * tint, "ambient": ambient}


def light_room(
    room: Room, openings: Sequence[Opening], origin_m: np.ndarray, lighting: Lighting, rng: np.random.Generator
) -> tuple[Lights, list[Prism], Sun]:
    """Return the lights of the camera's room, the lamps as prisms, and the sun; `origin_m` is the camera position."""
    windows = sorted(
        (opening for opening in openings if opening.kind == "window"),
        key=lambda window: -(window.end_m - window.start_m) * (window.head_m - window.sill_m),
    )[:_MAX_WINDOWS]
    lights = [_window_light(room, window, origin_m, lighting) for window in windows if lighting.daylight > 0.0]
    rows, prisms = _lamps(room, origin_m, lighting, lit=lighting.lamps_on or not lights, rng=rng)
    sun = Sun(np.zeros(Sun.WIDTH))
    if windows and lighting.daylight > 0.0 and rng.random() < 0.4:
        sun = _sun(room, windows[int(rng.integers(len(windows)))], origin_m, rng)
    return Lights.stacked(lights + rows), prisms, sun


def relit(scene: RenderScene, mood: Mood) -> RenderScene:
    """Return the scene in another light; `raw` is the neutral light that it was built with."""
    lamp, sky = np.array(_LAMP_TINTS[mood]), np.array(_SKY_TINTS[mood])
    lights, rooms, surfaces = scene.lights.copy(), scene.rooms.copy(), scene.surfaces.copy()
    sun, backdrop = scene.sun.copy(), scene.backdrop.copy()
    is_lamp = ~lights.normal.any(axis=1, keepdims=True)
    lights.colour *= np.where(is_lamp, lamp, sky)
    rooms.light_colour *= lamp
    # Ambient light comes from both.
    rooms.ambient *= np.sqrt(lamp * sky)
    glowing = (surfaces.glow > 0.0) & (surfaces.is_outdoors == 0.0)
    surfaces.tint[glowing] *= lamp
    sun.colour *= sky
    backdrop.sky *= sky
    backdrop.ground *= sky
    return dataclasses.replace(scene, lights=lights, rooms=rooms, surfaces=surfaces, sun=sun, backdrop=backdrop)


def _window_light(room: Room, window: Opening, origin_m: np.ndarray, lighting: Lighting) -> Row:
    start, along, inwards = wall_frame(room, window.wall)
    centre = start + along * 0.5 * (window.start_m + window.end_m) + inwards * 0.05 - origin_m
    area = (window.end_m - window.start_m) * (window.head_m - window.sill_m)
    power = 0.9 * lighting.daylight * area * lighting.sky_colour
    z = 0.5 * (window.sill_m + window.head_m)
    return Lights.row(xy_m=centre, z_m=z, colour=power, normal=inwards)


def _lamps(
    room: Room, origin_m: np.ndarray, lighting: Lighting, lit: bool, rng: np.random.Generator
) -> tuple[list[Row], list[Prism]]:
    """Return one lamp in the middle of the room, a second in a large room or on a wall; or a ceiling of downlights."""
    spots = [np.array(room.shape.representative_point().coords[0])]
    if room.area_m2 > 18.0:
        x_min, y_min, x_max, y_max = room.shape.bounds
        other = rng.uniform((x_min, y_min), (x_max, y_max))
        if shapely.contains_xy(room.shape.buffer(-0.5), *other):
            spots.append(other)
    rows, prisms = [], []
    finish: Finish = "glow" if lit else "white"
    power = math.exp(rng.uniform(math.log(0.8), math.log(4.0))) * (0.5 + room.area_m2 / 15.0) / len(spots)
    ceiling = room.ceiling_height_m
    style = int(rng.integers(5))
    if style == _DOWNLIGHTS:
        prisms += _downlights(room, finish, rng)
    for spot in spots:
        drop = rng.uniform(0.3, 0.9) if style == 0 and np.hypot(*(spot - origin_m)) > 0.6 else 0.0
        radius = rng.uniform(0.1, 0.3)
        thickness = rng.uniform(0.02, 0.12) if style != 3 else 0.01
        clear = shapely.contains_xy(room.shape.buffer(-radius - 0.02), *spot)
        if clear and style != _DOWNLIGHTS:
            if drop:
                prisms.append(_hanging(spot, 0.008, (ceiling - drop, ceiling - 1e-3), "dark"))
            z1 = ceiling - drop - 1e-3
            z0 = z1 - (rng.uniform(0.12, 0.3) if drop else thickness)
            prisms.append(_hanging(spot, radius, (z0, z1), finish, is_round=style != 2))
        if lit:
            # Lamps of one room can differ in colour.
            colour = lighting.lamp_colour * np.exp(rng.normal(0.0, 0.08, 3))
            rows.append(Lights.row(xy_m=spot - origin_m, z_m=ceiling - drop - 0.2, colour=power * colour))
    if lit and len(rows) == 1 and rng.random() < 0.15:
        row, lamp = _wall_lamp(room, origin_m, lighting, rng)
        rows.append(row)
        prisms.append(lamp)
    return rows, prisms


def _hanging(
    spot_m: np.ndarray, radius_m: float, z_m: tuple[float, float], finish: Finish, *, is_round: bool = True
) -> Prism:
    return Prism(spot_m, np.array([1.0, 0.0]), (radius_m, radius_m), z_m, finish, _NO_PIECE, is_round)


def _downlights(room: Room, finish: Finish, rng: np.random.Generator) -> list[Prism]:
    x_min, y_min, x_max, y_max = room.shape.bounds
    step, radius = rng.uniform(0.9, 2.0), rng.uniform(0.035, 0.08)
    xs, ys = np.arange(x_min + 0.4, x_max, step), np.arange(y_min + 0.4, y_max, step)
    spots = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    spots = spots[shapely.contains_xy(room.shape.buffer(-0.15), spots[:, 0], spots[:, 1])][:_MAX_DOWNLIGHTS]
    z1 = room.ceiling_height_m - 1e-3
    return [_hanging(spot, radius, (z1 - 0.008, z1), finish) for spot in spots]


def _wall_lamp(room: Room, origin_m: np.ndarray, lighting: Lighting, rng: np.random.Generator) -> tuple[Row, Prism]:
    """Return a lamp that lights the longest wall."""
    lengths = np.hypot(*(room.walls_m[:, 2:] - room.walls_m[:, :2]).T)
    wall = int(lengths.argmax())
    start, along, inwards = wall_frame(room, wall)
    foot = start + along * lengths[wall] * rng.uniform(0.15, 0.85)
    at, z = foot + inwards * 0.06, rng.uniform(1.6, 1.95)
    power = math.exp(rng.uniform(math.log(0.15), math.log(0.8)))
    light = Lights.row(xy_m=foot + inwards * 0.2 - origin_m, z_m=z, colour=power * lighting.lamp_colour)
    lamp = Prism(at, along, (0.06, 0.04), (z - 0.1, z + 0.1), "glow", _NO_PIECE)
    return light, lamp


def _sun(room: Room, window: Opening, origin_m: np.ndarray, rng: np.random.Generator) -> Sun:
    start, along, inwards = wall_frame(room, window.wall)
    side, elevation = rng.uniform(-1.0, 1.0), math.radians(rng.uniform(15.0, 55.0))
    toward = math.cos(side) * -inwards + math.sin(side) * along
    direction = [*(toward * math.cos(elevation)), math.sin(elevation)]
    colour = math.exp(rng.uniform(math.log(1.5), math.log(14.0))) * np.array([1.0, 0.93, 0.8])
    row = Sun.row(
        direction=direction,
        wall_start_m=start - origin_m,
        wall_along=along,
        s0_m=window.start_m + _FRAME_M,
        s1_m=window.end_m - _FRAME_M,
        z0_m=window.sill_m + _FRAME_M,
        z1_m=window.head_m - _FRAME_M,
        colour=colour,
    )
    return Sun(row)


def sample_backdrop(rng: np.random.Generator) -> Backdrop:
    """Draw the outdoors: sky, ground or foliage, and the height and outline of objects before the sky."""
    sky = rng.uniform(0.7, 1.0) * np.array([rng.uniform(0.7, 1.0), rng.uniform(0.85, 1.0), 1.0])
    ground = rng.uniform(0.05, 0.5) * np.array([rng.uniform(0.6, 1.1), 1.0, rng.uniform(0.4, 1.0)])
    horizon, ruggedness = rng.uniform(-0.15, 0.6), rng.uniform(0.02, 0.25)
    turn, lift = rng.uniform(0.0, 1.0, 2)
    row = Backdrop.row(sky=sky, ground=ground, horizon=horizon, ruggedness=ruggedness, turn=turn, lift=lift)
    return Backdrop(row)
