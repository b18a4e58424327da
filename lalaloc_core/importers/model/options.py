"""What whoever imports a plan may say about the file: typed, checked, the same over HTTP and on the command line."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, fields

from lalaloc_core.errors import InvalidFloorPlanError

METRES_PER_UNIT: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_SCALE = re.compile(r"(?:1\s*[:/]\s*)?(\d+(?:\.\d+)?)")
_MAX_LENGTH, _MAX_LAYERS = 200, 100
_CEILING_M = (1.0, 20.0)


@dataclass(frozen=True)
class KnownDistance:
    """Two points of a drawing, (x, y) in the file's coordinates (pixels of a picture), and how far apart they are."""

    start: tuple[float, float]
    end: tuple[float, float]
    distance_m: float

    def __post_init__(self) -> None:
        numbers = (*self.start, *self.end, self.distance_m)
        if not all(math.isfinite(number) for number in numbers) or self.drawn <= 0.0 or self.distance_m <= 0.0:
            raise InvalidFloorPlanError(
                f"known_distance is {numbers}, it must be x0, y0, x1, y1, metres: two places and a length above 0"
            )

    @property
    def drawn(self) -> float:
        """Distance of the points in the drawing."""
        return math.dist(self.start, self.end)

    @property
    def metres_per_unit(self) -> float:
        """The scale that follows."""
        return self.distance_m / self.drawn


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """What the file does not say of itself, or says wrongly. Everything is optional.

    Attributes:
        units: unit of the file's coordinates.
        scale: denominator of a drawing's scale on paper: 100 for "1:100" (PDF, SVG).
        metres_per_pixel: length of a pixel, or of a user unit of an SVG.
        known_distance: two points and their distance, another way to say the scale.
        level: name or number of the storey to take, where the file has several.
        layers: take only these layers, groups or classes (without regard to case).
        page: which page of a PDF, counted from 1.
        y_axis: which way y points in the file, where it is not as its format has it.
        ceiling_height_m: of rooms whose file gives none.
        name: what to call the plan.
    """

    units: str | None = None
    scale: float | None = None
    metres_per_pixel: float | None = None
    known_distance: KnownDistance | None = None
    level: str | None = None
    layers: tuple[str, ...] = ()
    page: int = 1
    y_axis: str | None = None
    ceiling_height_m: float | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if self.units is not None and self.units not in METRES_PER_UNIT:
            raise InvalidFloorPlanError(f"units is '{self.units}', known are {', '.join(METRES_PER_UNIT)}")
        _within("scale", self.scale, 1.0, 10_000.0)
        _within("metres_per_pixel", self.metres_per_pixel, 1e-6, 10.0)
        _within("page", self.page, 1.0, 10_000.0)
        _within("ceiling_height_m", self.ceiling_height_m, *_CEILING_M)
        if self.y_axis not in (None, "up", "down"):
            raise InvalidFloorPlanError(f"y_axis is '{self.y_axis}', known are up, down")
        if len(self.layers) > _MAX_LAYERS:
            raise InvalidFloorPlanError(f"{len(self.layers)} layers, at most {_MAX_LAYERS} can be named")
        for text in (*self.layers, *filter(None, (self.level, self.name))):
            _check_text(text)
        said = [name for name in ("scale", "metres_per_pixel", "known_distance") if getattr(self, name) is not None]
        if len(said) > 1:
            raise InvalidFloorPlanError(f"{' and '.join(said)} say the scale more than once, give one of them")

    @classmethod
    def from_text(cls, values: Mapping[str, str]) -> ImportOptions:
        """Options from form fields or a command line.

        `scale` may be written "1:100", `layers` is separated by commas, `known_distance` is "x0, y0, x1, y1, metres".

        Raises:
            InvalidFloorPlanError: an unknown option, or a value that it cannot have.
        """
        known = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InvalidFloorPlanError(f"unknown option '{unknown[0][:50]}', known are {', '.join(sorted(known))}")
        given = {name: text.strip() for name, text in values.items() if text.strip()}
        return cls(**{name: _parse(name, text) for name, text in given.items()})  # type: ignore[arg-type]

    def wants_layer(self, *names: str) -> bool:
        """Whether something on a layer, or of any of these classes, is to be taken."""
        wanted = {layer.casefold() for layer in self.layers}
        return not wanted or any(name.casefold() in wanted for name in names)


def _parse(name: str, text: str) -> object:
    if name == "scale":
        match = _SCALE.fullmatch(text)
        if match is None:
            raise InvalidFloorPlanError(f"scale is '{text[:50]}', it must look like 1:100")
        return float(match[1])
    if name == "known_distance":
        numbers = [_number(name, part) for part in re.split(r"[,;\s]+", text)]
        if len(numbers) != 5:
            raise InvalidFloorPlanError(f"known_distance has {len(numbers)} numbers, it needs x0, y0, x1, y1, metres")
        x0, y0, x1, y1, metres = numbers
        return KnownDistance((x0, y0), (x1, y1), metres)
    if name == "layers":
        return tuple(part.strip() for part in text.split(",") if part.strip())
    if name == "page":
        if not text.isascii() or not text.isdigit() or len(text) > 9:
            raise InvalidFloorPlanError(f"page is '{text[:50]}', it must be a whole number from 1")
        return int(text)
    if name in ("metres_per_pixel", "ceiling_height_m"):
        return _number(name, text)
    return text


def _number(name: str, text: str) -> float:
    try:
        # Python reads 1_000 as a number, nobody else does.
        value = math.nan if "_" in text else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidFloorPlanError(f"{name} is '{text[:50]}', it must be a number")
    return value


def _within(name: str, value: float | int | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise InvalidFloorPlanError(f"{name} is {value:g}, it must lie between {low:g} and {high:g}")


def _check_text(text: str) -> None:
    if len(text) > _MAX_LENGTH or any(unicodedata.category(character) in {"Cc", "Cs"} for character in text):
        raise InvalidFloorPlanError(
            f"'{text[:50]!a}' is no usable name of a plan, level or layer: at most {_MAX_LENGTH} printable characters"
        )


DEFAULT_OPTIONS = ImportOptions()
