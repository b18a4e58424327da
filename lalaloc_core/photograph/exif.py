"""Focal length, time and camera of a photograph by its EXIF metadata, without its position or owner.

Phones write `FocalLengthIn35mmFilm`, which is preferred: it holds after scaling, and phones include digital zoom.
Otherwise `FocalLength` is divided by the width of the sensor, from `FocalPlaneXResolution`, and multiplied by
`DigitalZoomRatio`. Values are not trusted: a zero means unknown by the standard (CIPA DC-008), and values out of
range are ignored with a warning.
"""

from __future__ import annotations

import math
import re
import struct
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

from PIL import ExifTags, Image

# Diagonal of 35 mm film (36 x 24 mm), which equivalent focal lengths refer to (CIPA DC-008, FocalLengthIn35mmFilm).
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Sides of a 4:3 sensor with that diagonal.
_LONG_MM, _SHORT_MM = 0.8 * _FILM_DIAGONAL_MM, 0.6 * _FILM_DIAGONAL_MM
_CAMERAS = tomllib.loads(Path(__file__).with_name("action_cameras.toml").read_text(encoding="utf-8"))
_FISHEYES = [(re.compile(pattern, re.I), angle_deg) for pattern, angle_deg in _CAMERAS["fisheyes"].items()]
# Longer equivalent focal lengths of these cameras are those of linear and narrow modes.
_MAX_FISHEYE_MM = 18.0
# A crop that Lightroom, unless the pixels do not have it yet, or darktable states.
_HAS_CROP = re.compile(
    rb":HasCrop(?:=.|>)\s{0,9}[Tt]rue|:Crop(?:Left|Top)(?:=.|>)\s{0,9}0\.0{0,9}[1-9]|"
    rb":operation=.(?:crop|clipping).[^<>]{1,99}enabled=.1"
)
_NOT_APPLIED = re.compile(rb":AlreadyApplied\s{0,9}(?:=\s{0,9}.|>)\s{0,9}[Ff]alse")
_SIZES = re.compile(rb"tiff:Image(Width|Length)\s{0,9}(?:=\s{0,9}.|>)\s{0,9}(\d{1,6})")
# Editors, after which a picture can be a part of what its focal length is for.
_EDITORS = re.compile("affinity|canva|darktable|gimp|google|irfan|light ?room|paint|photo|pic|pix|snap|therapee", re.I)
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_RANGE_MM = (4.0, 250.0)
_FOCAL_RANGE_MM = (0.5, 250.0)
_SENSOR_RANGE_MM = (1.5, 60.0)
_ZOOM_RANGE = (1.0, 20.0)
# Relative difference of aspect ratios from which a picture counts as cropped after it was taken.
_CROPPED = 0.03
# Ratios of the sides of cameras' pictures, and their relative deviation; sides are multiples of some pixels.
_SHAPES, _SHAPE_SD, _MULTIPLE = (1.0, 8 / 7, 1.25, 4 / 3, 1.5, 16 / 9, 2.0, 2.06, 2.11, 2.17, 2.22, 2.33), 0.015, 4
# `CustomRendered` of Apple's panorama mode, in which the focal length is that of the moving camera.
_STRIP = 6
# Relative standard deviations of the focal length: rounding and lens of the usual shapes, and of cropped sensors.
_SD, _CROPPED_SD = 0.03, 0.06
# Characters of a maker's or model's name.
MAX_NAME = 60
# The farthest time zones from UTC, in minutes.
_MAX_OFFSET_MIN = 14 * 60
# Times as cameras and editors write them: "2024:05:01 10:20:30", "2024-05-01T10:20:30.5+02:00", "2024/5/1 3:20 p. m.".
_AFTERNOON, _MORNING = "下午 午後 오후 pm ch μμ م", "上午 午前 오전 am sa πμ ص"
_HALVES = "|".join(r"\.? ?".join(half) + r"\.?" for half in f"{_AFTERNOON} {_MORNING}".split())
_TIME = re.compile(
    rf"(\d{{4}})[:./-] ?(\d\d?)[:./-] ?(\d\d?)[T ,]+({_HALVES})? *(\d\d?)[:.] ?(\d\d?)(?:[:.] ?(\d\d?))?"
    rf"(?:[.,](\d{{1,6}})\d*)? *({_HALVES})? *(Z|UTC|GMT|[+-]\d\d?(?::?\d\d)?)?",
    re.IGNORECASE,
)
_TIMES = (
    (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal, ExifTags.Base.OffsetTimeOriginal),
    (ExifTags.Base.DateTimeDigitized, ExifTags.Base.SubsecTimeDigitized, ExifTags.Base.OffsetTimeDigitized),
)
# Times that XMP packets state; the first names are the surest.
_XMP_TIME = re.compile(
    rb"\b(exif:DateTimeOriginal|photoshop:DateCreated|xmp:CreateDate)\s{0,9}(?:=\s{0,9}.|>)\s{0,9}([^\"'<>]{10,40})"
)


@dataclass(frozen=True, kw_only=True)
class ExifLens:
    """Statements of the EXIF metadata about the lens.

    Attributes:
        focal: focal length, pixels of the full picture; None if unknown.
        strip: the picture is a strip of a phone's panorama mode.
        is_doubtful: the picture was edited, or its size changed, so it can be a part of what the focal length is for.
        fisheye: angle (radians) across the longer side, if the camera's wide lens is a fisheye; else None.
    """

    focal: float | None = None
    focal_sd: float = 0.0
    strip: bool = False
    is_doubtful: bool = False
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
    sizes, long, ratio = stated_sizes(exif, packets), max(width, height), max(width, height) / min(width, height)
    has_crop = any(map(_HAS_CROP.search, packets)) and not any(map(_NOT_APPLIED.search, packets))
    is_odd = all(abs(ratio / shape - 1.0) > _SHAPE_SD for shape in _SHAPES)
    if has_crop or is_odd or any(abs(max(size) / min(size) / ratio - 1.0) > _CROPPED for size in sizes):
        if film is not None or lens is not None:
            warnings.append("the photograph was cropped after it was taken, so its EXIF focal length is not used")
        return ExifLens(warnings=tuple(warnings))
    usual = min(abs(ratio - 4.0 / 3.0), abs(ratio - 1.5)) < 0.05
    focal = None
    if film is not None:
        focal = film / _film_side_mm(ratio) * long
    elif lens is not None and (side_mm := _sensor_side_mm(tags, warnings)) is not None:
        focal = zoom * lens / side_mm * long
    is_edited = _EDITORS.search(_text(exif.get(ExifTags.Base.Software))) is not None
    is_edited |= any(side % _MULTIPLE for side in (width, height))
    # Makers disagree whether the equivalent focal length includes digital zoom.
    doubt = 0.5 * math.log(zoom) if film is not None else 0.0
    camera = " ".join(_text(exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model)).strip()
    fisheye = fisheye_of(camera) if film is None or film <= _MAX_FISHEYE_MM else None
    return ExifLens(
        focal=focal,
        focal_sd=max(_SD if usual else _CROPPED_SD, doubt),
        is_doubtful=is_edited or any(sorted(size) != sorted((width, height)) for size in sizes),
        fisheye=fisheye,
        camera="" if fisheye is None else camera,
        warnings=tuple(warnings),
    )


def fisheye_of(camera: str) -> float | None:
    """Return the angle (radians) across the longer side of an action camera's wide lens, by its maker and model."""
    return next((math.radians(angle_deg) for pattern, angle_deg in _FISHEYES if pattern.match(camera)), None)


def _film_side_mm(ratio: float) -> float:
    """Return the longer side of the picture on film, filled at 3:2; other shapes are crops of a 4:3 sensor."""
    if abs(ratio - 1.5) < 0.05:
        return 36.0
    return _LONG_MM if ratio >= 4.0 / 3.0 else _SHORT_MM * ratio


def _sensor_side_mm(tags: dict[int, object], warnings: list[str]) -> float | None:
    """Return the longer side of the sensor, from the pixels per unit on it."""
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
    return None


def stated_sizes(exif: Image.Exif, packets: Sequence[bytes]) -> list[tuple[int, int]]:
    """Return the sizes (width, height) that metadata state of the stored picture; editors leave old ones."""
    base = ExifTags.Base
    tags: dict[int | bytes, object] = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    tags |= dict(found for packet in packets for found in _SIZES.findall(packet))
    names = ((base.ExifImageWidth, base.ExifImageHeight), (base.ImageWidth, base.ImageLength), (b"Width", b"Length"))
    sizes = [(finite_number(tags.get(width)) or 0.0, finite_number(tags.get(height)) or 0.0) for width, height in names]
    return [(round(width), round(height)) for width, height in sizes if min(width, height) >= 1.0]


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


def read_taken(exif: Image.Exif, packets: Sequence[bytes], *, width: int, height: int) -> Taken:
    """Read time and camera of an upright picture of `width` x `height` pixels, by Exif, XMP or GPS."""
    make, model = (_text(exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    # The time of the file's last change is not used.
    texts = [[_text(tags.get(tag)) for tag in names] for names in _TIMES]
    texts = [[at, digits, zone or _text(tags.get(ExifTags.Base.OffsetTime))] for at, digits, zone in texts]
    stated = sorted(found for packet in packets for found in _XMP_TIME.findall(packet))
    texts += [[text.decode(errors="replace").strip()] for _, text in stated]
    at = next(filter(None, (read_time(*text) for text in texts)), None) or _time_of_gps(exif)
    return Taken(at=at, make=make, model=model, width=width, height=height)


def _time_of_gps(exif: Image.Exif) -> datetime | None:
    """Return the time of the last fix, which can be some minutes early; None without one."""
    try:
        tags = exif.get_ifd(ExifTags.IFD.GPSInfo)
        hour, minute, second = (int(part) for part in tags[ExifTags.GPS.GPSTimeStamp])
    except (ArithmeticError, LookupError, OSError, SyntaxError, TypeError, ValueError, struct.error):
        return None
    return read_time(f"{_text(tags.get(ExifTags.GPS.GPSDateStamp))} {hour:02d}:{minute:02d}:{second:02d}Z")


def read_time(text: str, subseconds: str = "", offset: str = "") -> datetime | None:
    """Read a time in any common form, with digits of its second and its time zone; None if it is none."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    year, month, day, before, hour, minute, second, digits, after, zone = found.groups()
    half = re.sub(r"[. ]", "", before or after or "").casefold()
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
    found = re.fullmatch(r"([+-])(\d\d??)(?::?(\d\d))?", offset.strip())
    if found is None:
        return UTC if offset.strip().upper() in ("Z", "UTC", "GMT") else None
    minutes = 60 * int(found[2]) + int(found[3] or 0)
    return timezone(timedelta(minutes=-minutes if found[1] == "-" else minutes)) if minutes <= _MAX_OFFSET_MIN else None


def _text(value: object) -> str:
    """Return a text of the metadata as it is printed, empty if there is none."""
    text = "" if value is None else str(value)[: 2 * MAX_NAME]
    return "".join(filter(str.isprintable, text)).strip()[:MAX_NAME]
