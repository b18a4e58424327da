"""Options of an import, the same in Python, over HTTP and on the command line."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

from lalaloc_core.errors import InvalidFloorPlanError

METRES_PER_UNIT: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
# Options that are written in a form of their own, with its description.
_WRITTEN: Mapping[str, tuple[re.Pattern[str], str, Callable[[str], object]]] = {
    "scale": (re.compile(r"(?:1\s*[:/]\s*)?(\d+(?:\.\d+)?)"), "look like 1:100", float),
    "page": (re.compile(r"([0-9]{1,9})"), "be a whole number from 1", int),
    "plan": (re.compile(r"(true|false)", re.IGNORECASE), "be true or false", lambda text: text.casefold() == "true"),
}
_MAX_LENGTH, _MAX_LAYERS = 200, 100
_RANGES: Mapping[str, tuple[float, float]] = {
    "scale": (1.0, 10_000.0), "metres_per_pixel": (1e-6, 10.0), "multiply": (1e-3, 1e3), "page": (1.0, 10_000.0),
    "ceiling_height_m": (1.0, 20.0),
}  # fmt: skip
_NUMBERS = {"known_distance": (5, "x0, y0, x1, y1, metres"), "crop": (4, "x0, y0, x1, y1 of two opposite corners")}
# Numbers of a known distance, and the lengths of a unit of a drawing that follow (m).
_MAX_NUMBER, _METRES_PER_UNIT = 1e10, (1e-9, 1e4)


@dataclass(frozen=True)
class KnownDistance:
    """Two points (x, y) of a drawing, in the file's coordinates (pixels of a picture), and their distance (m)."""

    start: tuple[float, float]
    end: tuple[float, float]
    distance_m: float

    def __post_init__(self) -> None:
        numbers = (*self.start, *self.end, self.distance_m)
        is_usable = all(abs(number) <= _MAX_NUMBER for number in numbers) and self.drawn > 0.0
        if not is_usable or not _METRES_PER_UNIT[0] <= self.metres_per_unit <= _METRES_PER_UNIT[1]:
            raise InvalidFloorPlanError(
                f"known_distance is {numbers}; give x0, y0, x1, y1, metres, numbers up to {_MAX_NUMBER:g} with two "
                f"different points; a unit must be {_METRES_PER_UNIT[0]:g} to {_METRES_PER_UNIT[1]:g} m"
            )

    @property
    def drawn(self) -> float:
        """Distance of the points in units of the drawing."""
        return math.dist(self.start, self.end)

    @property
    def metres_per_unit(self) -> float:
        """Resulting length of a unit of the drawing."""
        return self.distance_m / self.drawn


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Facts that the file does not give, or gives wrongly. All are optional.

    Attributes:
        units: unit of the file's coordinates.
        scale: denominator of a drawing's scale on paper, 100 for "1:100" (PDF, SVG).
        metres_per_pixel: length of a pixel, or of a user unit of an SVG.
        level: name or number of the storey to import, if the file has several.
        layers: layers, groups or classes to import, ignoring case; empty for all.
        page: page of a PDF, counted from 1.
        multiply: factor for all lengths of a drawing, whose scale is false.
        crop: part of a page or picture that is read: x0, y0, x1, y1 of two opposite corners, in the file's coordinates.
        y_axis: direction of y in the file, "up" or "down", if it differs from the format's.
        ceiling_height_m: ceiling height of rooms without one in the file.
        plan: the file is a plan, although it looks like a photograph.
    """

    units: str | None = None
    scale: float | None = None
    metres_per_pixel: float | None = None
    known_distance: KnownDistance | None = None
    level: str | None = None
    layers: tuple[str, ...] = ()
    page: int = 1
    multiply: float | None = None
    crop: tuple[float, float, float, float] | None = None
    y_axis: str | None = None
    ceiling_height_m: float | None = None
    name: str | None = None
    plan: bool = False

    def __post_init__(self) -> None:
        if self.units is not None:
            check_units(self.units)
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InvalidFloorPlanError(f"{name} is {value:g}; it must be between {low:g} and {high:g}")
        if self.crop is not None:
            object.__setattr__(self, "crop", _ordered_crop(self.crop))
        if self.y_axis is not None:
            check_y_axis(self.y_axis)
        if len(self.layers) > _MAX_LAYERS:
            raise InvalidFloorPlanError(f"layers has {len(self.layers)} names; the limit is {_MAX_LAYERS}")
        for text in (*self.layers, *filter(None, (self.level, self.name))):
            _check_text(text)
        scales = [name for name in ("scale", "metres_per_pixel", "known_distance") if getattr(self, name) is not None]
        if len(scales) > 1:
            raise InvalidFloorPlanError(f"{' and '.join(scales)} each set the scale; give only one of them")

    @classmethod
    def from_text(cls, values: Mapping[str, str]) -> ImportOptions:
        """Parse options from form fields or the command line.

        `scale` can be written "1:100", `layers` is separated by commas, `known_distance` is "x0, y0, x1, y1, metres".

        Raises:
            InvalidFloorPlanError: unknown option or invalid value.
        """
        known = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InvalidFloorPlanError(f"unknown option '{unknown[0][:50]}'; options are {', '.join(sorted(known))}")
        given = {name: text.strip() for name, text in values.items() if text.strip()}
        return cls(**{name: _parse(name, text) for name, text in given.items()})  # type: ignore[arg-type]

    def includes_layer(self, *names: str) -> bool:
        """Return whether `layers` is empty or holds any of these names."""
        wanted = {layer.casefold() for layer in self.layers}
        return not wanted or any(name.casefold() in wanted for name in names)


def check_units(units: object) -> str:
    """Return a known unit."""
    if not isinstance(units, str) or units not in METRES_PER_UNIT:
        raise InvalidFloorPlanError(f"units is {str(units)[:50]!r}; set it to one of {', '.join(METRES_PER_UNIT)}")
    return units


def check_y_axis(y_axis: object) -> None:
    """Check a direction of y."""
    if y_axis not in ("up", "down"):
        raise InvalidFloorPlanError(f"y_axis is {str(y_axis)[:50]!r}; set it to up or down")


def _parse(name: str, text: str) -> object:
    if name in _WRITTEN:
        pattern, expected, convert = _WRITTEN[name]
        if (match := pattern.fullmatch(text)) is None:
            raise InvalidFloorPlanError(f"{name} is '{text[:50]}'; it must {expected}")
        return convert(match[1])
    if name in _NUMBERS:
        numbers, (count, meaning) = [_number(name, part) for part in re.split(r"[,;\s]+", text)], _NUMBERS[name]
        if len(numbers) != count:
            raise InvalidFloorPlanError(f"{name} has {len(numbers)} numbers; give {meaning}")
        x0, y0, x1, y1, *distance_m = numbers
        return KnownDistance((x0, y0), (x1, y1), *distance_m) if distance_m else (x0, y0, x1, y1)
    if name == "layers":
        return tuple(part.strip() for part in text.split(",") if part.strip())
    return _number(name, text) if name in _RANGES else text


def _ordered_crop(crop: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return the corners of a part as (left, lowest y, right, highest y)."""
    x0, y0, x1, y1 = crop
    if not all(abs(number) <= _MAX_NUMBER for number in crop) or x0 == x1 or y0 == y1:
        raise InvalidFloorPlanError(
            f"crop is {', '.join(f'{number:g}' for number in crop)}; give x0, y0, x1, y1 of two opposite corners, "
            f"numbers up to {_MAX_NUMBER:g}"
        )
    return min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)


def to_number(text: object) -> float:
    """Return the number in a text, NaN if there is none; float() accepts 1_000, which other tools do not."""
    try:
        return math.nan if "_" in str(text) else float(str(text))
    except ValueError:
        return math.nan


def _number(name: str, text: str) -> float:
    if not math.isfinite(value := to_number(text)):
        raise InvalidFloorPlanError(f"{name} is '{text[:50]}'; it must be a number")
    return value


def _check_text(text: str) -> None:
    if len(text) > _MAX_LENGTH or any(unicodedata.category(character) in {"Cc", "Cs"} for character in text):
        raise InvalidFloorPlanError(
            f"the name {text[:50]!a} is invalid; name, level and layers take up to {_MAX_LENGTH} printable characters"
        )


DEFAULT_OPTIONS = ImportOptions()
