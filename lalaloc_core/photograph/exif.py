"""Focal length, time and camera of a photograph by its EXIF metadata, without its position or owner.

Phones write `FocalLengthIn35mmFilm`, which is preferred: it holds after scaling, and phones include digital zoom.
Otherwise `FocalLength` is divided by the width of the sensor, from `FocalPlaneXResolution` or a table, and multiplied
by `DigitalZoomRatio`. Values are not trusted: a zero means unknown by the standard (CIPA DC-008), and values out of
range are ignored with a warning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone

from PIL import ExifTags, Image

# Diagonal of 35 mm film (36 x 24 mm), which equivalent focal lengths refer to (CIPA DC-008, FocalLengthIn35mmFilm).
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Sides of a 4:3 sensor with that diagonal.
_LONG_MM, _SHORT_MM = 0.8 * _FILM_DIAGONAL_MM, 0.6 * _FILM_DIAGONAL_MM
# Phones that write no equivalent focal length, at least with their first software: focal length of the rear camera (mm,
# as in its files) and longer side of the sensor (mm, openMVG's CameraSensorSizeDatabase).
_SENSORS_MM = {
    "iphone 4": (3.85, 4.54),
    "iphone 4s": (4.28, 4.54),
    "iphone 5": (4.13, 4.54),
    "iphone 5s": (4.15, 4.89),
    "iphone 6": (4.15, 4.89),
    "iphone 6 plus": (4.15, 4.89),
}
# Action cameras whose wide lens is a fisheye: maker and model, and the angle (degrees) across the longer side at 4:3:
# as the maker states it (GoPro), else 0.8 of the diagonal that it states.
_FISHEYES = tuple(
    (re.compile(pattern, re.I), angle_deg)
    for pattern, angle_deg in (
        (r"gopro\b", 122.6),
        (r"dji.*(action|\bac00\d)", 124.0),
        (r"(arashi vision|insta360)\b", 126.0),
        (r"(sjcam|akaso|eken|apeman|campark|dragon touch|thieye|victure)\b", 136.0),
        (r"(xiaoyi|yi technology|yi)\b", 124.0),
        (r"sony (hdr-a|fdr-x[13]0)", 136.0),
        (r"garmin.*virb", 122.0),
    )
)
# Longer equivalent focal lengths of these cameras are those of linear and narrow modes.
_MAX_FISHEYE_MM = 18.0
# A crop that an editor states, as an attribute or element of the Camera Raw schema.
_HAS_CROP = re.compile(rb"crs:HasCrop\s{0,9}(?:=\s{0,9}[\"']|>)\s{0,9}True", re.IGNORECASE)
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_RANGE_MM = (4.0, 250.0)
_FOCAL_RANGE_MM = (0.5, 250.0)
_SENSOR_RANGE_MM = (1.5, 60.0)
_ZOOM_RANGE = (1.0, 20.0)
# Relative difference of aspect ratios from which a picture counts as cropped after it was taken.
_CROPPED = 0.03
# `CustomRendered` of Apple's panorama mode, in which the focal length is that of the moving camera.
_STRIP = 6
# Relative standard deviations of the focal length: rounding and lens of the usual shapes, and of cropped sensors.
_SD, _CROPPED_SD = 0.03, 0.06
# Characters of a maker's or model's name.
MAX_NAME = 60
# The farthest time zones from UTC, in minutes.
_MAX_OFFSET_MIN = 14 * 60
# Times as cameras and editors write them: "2024:05:01 10:20:30", "2024-05-01T10:20:30.5+02:00", "2024/5/1 3:20 PM".
_AFTERNOON, _MORNING = "下午 午後 오후 p.m. pm", "上午 午前 오전 a.m. am"
_HALVES = "|".join(re.escape(word) for word in f"{_AFTERNOON} {_MORNING}".split())
_TIME = re.compile(
    rf"(\d{{4}})[:./-](\d{{1,2}})[:./-](\d{{1,2}})[T ,]+({_HALVES})? *(\d{{1,2}})[:.](\d{{2}})(?:[:.](\d{{2}}))?"
    rf"(?:[.,](\d{{1,6}})\d*)? *({_HALVES})? *(Z|[+-]\d{{2}}:?\d{{2}})?",
    re.IGNORECASE,
)
_TIMES = (
    (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal, ExifTags.Base.OffsetTimeOriginal),
    (ExifTags.Base.DateTimeDigitized, ExifTags.Base.SubsecTimeDigitized, ExifTags.Base.OffsetTimeDigitized),
)


@dataclass(frozen=True, kw_only=True)
class ExifLens:
    """Statements of the EXIF metadata about the lens.

    Attributes:
        focal: focal length, pixels of the full picture; None if unknown.
        strip: the picture is a strip of a phone's panorama mode.
        fisheye: angle (radians) across the longer side, if the camera's wide lens is a fisheye; else None.
    """

    focal: float | None = None
    focal_sd: float = 0.0
    strip: bool = False
    fisheye: float | None = None
    camera: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Taken:
    """Time and camera of a photograph; None, empty or 0 for what is unknown.

    Attributes:
        at: time by the camera's clock, with its time zone if the file states one.
        width, height: size of the upright picture, pixels.
    """

    at: datetime | None = None
    make: str = ""
    model: str = ""
    width: int = 0
    height: int = 0


def read_exif_lens(exif: Image.Exif, packets: Sequence[bytes] = (), *, width: int, height: int) -> ExifLens:
    """Read the focal length of a picture of `width` x `height` pixels, in either orientation.

    `packets` are its XMP packets, in which editors state that they cropped it.
    """
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    warnings: list[str] = []
    if tags.get(ExifTags.Base.CustomRendered) == _STRIP:
        return ExifLens(strip=True)
    zoom = _in_range(tags, ExifTags.Base.DigitalZoomRatio, _ZOOM_RANGE, "", warnings) or 1.0
    film = _in_range(tags, ExifTags.Base.FocalLengthIn35mmFilm, _FILM_RANGE_MM, " mm", warnings)
    lens = _in_range(tags, ExifTags.Base.FocalLength, _FOCAL_RANGE_MM, " mm", warnings)
    if _is_cropped(tags, width, height) or any(map(_HAS_CROP.search, packets)):
        if film is not None or lens is not None:
            warnings.append("the photograph was cropped after it was taken, so its EXIF focal length is not used")
        return ExifLens(warnings=tuple(warnings))
    long, ratio = max(width, height), max(width, height) / min(width, height)
    usual = min(abs(ratio - 4.0 / 3.0), abs(ratio - 1.5)) < 0.05
    focal = None
    if film is not None:
        focal = film / _film_side_mm(ratio) * long
    elif lens is not None and (side_mm := _sensor_side_mm(exif, tags, lens, warnings)) is not None:
        focal = zoom * lens / side_mm * long
    # Makers disagree whether the equivalent focal length includes digital zoom.
    doubt = 0.5 * math.log(zoom) if film is not None else 0.0
    camera = " ".join(_text(exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model)).strip()
    is_wide = film is None or film <= _MAX_FISHEYE_MM
    angle_deg = next((angle for pattern, angle in _FISHEYES if pattern.match(camera)), None) if is_wide else None
    return ExifLens(
        focal=focal,
        focal_sd=max(_SD if usual else _CROPPED_SD, doubt),
        fisheye=None if angle_deg is None else math.radians(angle_deg),
        camera="" if angle_deg is None else camera,
        warnings=tuple(warnings),
    )


def _film_side_mm(ratio: float) -> float:
    """Return the longer side of the picture on film, filled at 3:2; other shapes are crops of a 4:3 sensor."""
    if abs(ratio - 1.5) < 0.05:
        return 36.0
    return _LONG_MM if ratio >= 4.0 / 3.0 else _SHORT_MM * ratio


def _sensor_side_mm(exif: Image.Exif, tags: dict[int, object], lens_mm: float, warnings: list[str]) -> float | None:
    """Return the longer side of the sensor, from the pixels per unit on it or the model."""
    density = finite_number(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = finite_number(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    unit_mm = None if unit is None else _UNITS_MM.get(round(unit))
    sides = [
        finite_number(tags.get(tag)) or 0.0 for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)
    ]
    if density and unit_mm and max(sides) > 0.0:
        side_mm = max(sides) / density * unit_mm
        if _SENSOR_RANGE_MM[0] <= side_mm <= _SENSOR_RANGE_MM[1]:
            return side_mm
        warnings.append(
            f"EXIF FocalPlaneXResolution gives a sensor of {side_mm:.3g} mm; it must be between "
            f"{_SENSOR_RANGE_MM[0]:g} and {_SENSOR_RANGE_MM[1]:g} mm, so it is ignored"
        )
    model = str(exif.get(ExifTags.Base.Model, "")).strip("\0 ").lower()
    known_mm, side_mm = _SENSORS_MM.get(model, (0.0, 0.0))
    # The front camera has another sensor.
    return side_mm if abs(lens_mm - known_mm) < 0.05 * lens_mm else None


def _is_cropped(tags: dict[int, object], width: int, height: int) -> bool:
    sides = [finite_number(tags.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    if not sides[0] or not sides[1] or min(sides[0], sides[1]) < 1.0:
        return False
    taken = max(sides[0], sides[1]) / min(sides[0], sides[1])
    return abs(taken * min(width, height) / max(width, height) - 1.0) > _CROPPED


def _in_range(
    tags: dict[int, object], tag: ExifTags.Base, limits: tuple[float, float], unit: str, warnings: list[str]
) -> float | None:
    """Return a tag's value; None if it is missing, zero (unknown) or out of range (with a warning)."""
    if tags.get(tag) is None:
        return None
    value = finite_number(tags[tag])
    if value == 0.0:
        return None
    if value is None or not limits[0] <= value <= limits[1]:
        shown = "not a number" if value is None else f"{value:g}{unit}"
        warnings.append(
            f"EXIF {tag.name} is {shown}; it must be between {limits[0]:g} and {limits[1]:g}{unit}, so it is ignored"
        )
        return None
    return value


def finite_number(value: object) -> float | None:
    """Return a finite number; None for text, several values and fractions with a denominator of zero."""
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def read_taken(exif: Image.Exif, *, width: int, height: int) -> Taken:
    """Read time and camera of an upright picture of `width` x `height` pixels."""
    make, model = (_text(exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    # The time of the file's last change is not used.
    times = (read_time(*(_text(tags.get(tag)) for tag in names)) for names in _TIMES)
    return Taken(at=next(filter(None, times), None), make=make, model=model, width=width, height=height)


def read_time(text: str, subseconds: str = "", offset: str = "") -> datetime | None:
    """Read a time in any common form, with digits of its second and its time zone; None if it is none."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    year, month, day, before, hour, minute, second, digits, after, zone = found.groups()
    half = (before or after or "").casefold()
    hours = int(hour) % 12 + 12 * (half in _AFTERNOON.split()) if half else 0 if hour == "24" else int(hour)
    fraction = (digits or subseconds)[:6].ljust(6, "0")
    microsecond = int(fraction) if fraction.isascii() and fraction.isdigit() else 0
    # Some phones write 24:05 for five past midnight, and seconds of 60 are leap seconds.
    parts = (int(year), int(month), int(day), hours, int(minute), min(int(second or 0), 59), microsecond)
    try:
        return datetime(*parts, tzinfo=_zone(zone or offset))
    except ValueError:
        return None


def _zone(offset: str) -> timezone | None:
    """Return a time zone such as "+02:00" or "Z"; None for none, or one that is none."""
    found = re.fullmatch(r"([+-])(\d{2}):?(\d{2})", offset.strip())
    if found is None:
        return UTC if offset.strip().upper() == "Z" else None
    minutes = 60 * int(found[2]) + int(found[3])
    return timezone(timedelta(minutes=-minutes if found[1] == "-" else minutes)) if minutes <= _MAX_OFFSET_MIN else None


def _text(value: object) -> str:
    """Return a text of the metadata as it is printed, empty if there is none."""
    text = "" if value is None else str(value)[: 2 * MAX_NAME]
    return "".join(filter(str.isprintable, text)).strip()[:MAX_NAME]
