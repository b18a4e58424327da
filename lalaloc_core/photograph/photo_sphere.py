"""Photo Sphere metadata: visible part of the sphere, pitch, roll and compass heading.

Read from the GPano properties of a picture (Google's Photo Sphere XMP metadata). The values are not trusted: values out
of range are ignored with a warning, and a contradictory part of the sphere is reported and not used. A packet that is
not well-formed XML, such as one whose prefix is not declared, is searched for the properties as text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from lalaloc_core.photograph.exif import finite_number

_MAX_SIDE = 1_000_000
_MAX_ANGLE_DEG = 180.0
# Relative difference of equal widths, heights and ratios; stitchers round.
_TOLERANCE = 0.01
_MIN_SHARE = 0.1
_CROP = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
)
_NAME = re.compile(r"\{https?://ns\.google\.com/photos/1\.0/panorama/?\}([A-Za-z]{1,40})")
# A packet of a JPEG fits into one segment of 64 KiB; larger ones, such as extensions, are searched as text.
_MAX_XML_BYTES = 256 * 1024
# Longest value that is read, and most warnings.
_MAX_VALUE, _MAX_WARNINGS = 50, 3
# An attribute with its value, or an element with its text.
_PROPERTY = re.compile(rb"GPano:([A-Za-z]{1,40})\s{0,9}(?:=\s{0,9}[\"']([^\"'<>]{0,200})[\"']|>([^<>]{0,200})<)")


@dataclass(frozen=True, kw_only=True)
class SpherePart:
    """The visible part of the full sphere, as shares of its width (360°) and height (180°)."""

    left: float
    top: float
    width: float
    height: float

    @property
    def azimuth(self) -> float:
        """Azimuth of the part's centre relative to that of the full sphere, radians clockwise."""
        return math.tau * (self.left + 0.5 * self.width - 0.5)


@dataclass(frozen=True, kw_only=True)
class PhotoSphere:
    """Photo Sphere metadata of a picture; angles in radians.

    Attributes:
        part: visible part of the sphere, None for all of it or if unknown.
        fault: problem with the metadata of `part`, None if they are valid or missing.
        refusal: reason that the metadata rule the picture out as a sphere, None if they do not.
        cylinder: horizontal field of view of a picture that the metadata state to be cylindrical; None if they do not.
        roll: clockwise rotation of the camera about its viewing direction; the horizon rotates counterclockwise.
        compass_heading: azimuth of the full sphere's centre, clockwise from true north; None if missing.
    """

    part: SpherePart | None = None
    fault: str | None = None
    refusal: str | None = None
    declared: bool = False
    cylinder: float | None = None
    pitch: float = 0.0
    roll: float = 0.0
    compass_heading: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def level(self) -> bool:
        """True if pitch and roll are zero."""
        return self.pitch == 0.0 and self.roll == 0.0


def read_photo_sphere(packets: Sequence[bytes], *, width: int, height: int) -> PhotoSphere:
    """Read the XMP packets of a picture of `width` x `height` pixels; unreadable packets count as missing."""
    values, conflicts = read_gpano(packets)
    projection = values.get("ProjectionType", "equirectangular")
    if projection.lower() != "equirectangular":
        return PhotoSphere(
            refusal=f"the projection is '{projection}'; only 'equirectangular' is supported",
            cylinder=_cylinder(values) if projection.lower() == "cylindrical" else None,
            warnings=conflicts,
        )
    part, fault = _part(values, width, height)
    share = 1.0 if part is None else part.width * part.height
    if share < _MIN_SHARE:
        return PhotoSphere(refusal=f"it shows {share:.1%} of the sphere; the minimum is {_MIN_SHARE:.0%}")
    warnings = list(conflicts)
    pitch = _angle(values, "PosePitchDegrees", warnings, largest_deg=90.0) or 0.0
    roll = _angle(values, "PoseRollDegrees", warnings) or 0.0
    heading = _angle(values, "PoseHeadingDegrees", warnings)
    return PhotoSphere(
        part=part,
        fault=fault,
        declared="ProjectionType" in values or any(name in values for name in _CROP),
        pitch=pitch,
        roll=roll,
        compass_heading=None if heading is None else heading % math.tau,
        warnings=tuple(warnings),
    )


def _number(values: dict[str, str], name: str) -> float | None:
    """Return a number, which can have a decimal comma; None if it is missing or none."""
    text = values.get(name)
    return None if text is None else finite_number(text.replace(",", ".") if text.count(",") == 1 else text)


def _angle(values: dict[str, str], name: str, warnings: list[str], largest_deg: float = _MAX_ANGLE_DEG) -> float | None:
    """Return an angle (radians) between -180° and 180°: some writers count a full turn, such as 340° for -20°."""
    degrees = _number(values, name)
    if degrees is not None and abs(degrees) <= 2.0 * _MAX_ANGLE_DEG:
        turned = degrees if abs(degrees) <= _MAX_ANGLE_DEG else degrees - math.copysign(2.0 * _MAX_ANGLE_DEG, degrees)
        if abs(turned) <= largest_deg:
            return math.radians(turned)
    if values.get(name):
        warnings.append(
            f"GPano {name} is '{values[name]}'; it must be between {-largest_deg:g} and {largest_deg:g}, up to a full "
            "turn, so it is ignored"
        )
    return None


def _cylinder(values: dict[str, str]) -> float | None:
    """Return the angle that a part of a cylinder shows."""
    full, part = (_number(values, name) for name in ("FullPanoWidthPixels", "CroppedAreaImageWidthPixels"))
    return math.tau * part / full if full and part and 0.0 < part <= full else None


def _part(values: dict[str, str], width: int, height: int) -> tuple[SpherePart | None, str | None]:
    """Return the visible part of the sphere, or the problem with its metadata."""
    if not any(name in values for name in _CROP):
        return None, None
    numbers = {name: _number(values, name) for name in _CROP}
    for name, number in numbers.items():
        if number is None or not 0.0 <= number <= _MAX_SIDE:
            return None, f"{name} is '{values.get(name, '')}'; it must be between 0 and {_MAX_SIDE}"
    full_width, full_height, part_width, part_height, left, top = (number or 0.0 for number in numbers.values())
    if min(full_width, full_height, part_width, part_height) < 1.0:
        return None, "a width or height is 0"
    if abs(full_width / full_height - 2.0) > 2.0 * _TOLERANCE:
        return None, f"the full sphere is {full_width:g} x {full_height:g}, not twice as wide as high"
    # One pixel is rounding.
    if left + part_width > full_width + 1.0 or top + part_height > full_height + 1.0:
        return None, (
            f"the part of {part_width:g} x {part_height:g} at ({left:g}, {top:g}) is not within the full sphere of "
            f"{full_width:g} x {full_height:g}"
        )
    # A picture that was scaled later keeps its metadata, so only the ratio is compared.
    if abs(width / height / (part_width / part_height) - 1.0) > _TOLERANCE:
        return None, f"the part is {part_width:g} x {part_height:g}, but the picture is {width} x {height}"
    if part_width >= full_width and part_height >= full_height:
        return None, None
    return (
        SpherePart(
            left=left / full_width,
            top=top / full_height,
            width=min(part_width, full_width - left) / full_width,
            height=min(part_height, full_height - top) / full_height,
        ),
        None,
    )


def read_gpano(packets: Sequence[bytes]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the GPano properties of all packets, and warnings; the first of each name counts."""
    found: dict[str, str] = {}
    warnings: list[str] = []
    for packet in packets:
        for name, value in _properties(packet):
            first = found.setdefault(name, value)
            if first != value:
                warnings.append(f"GPano {name} is stated as '{first}' and as '{value}'; the first is used")
    return found, tuple(dict.fromkeys(warnings))[:_MAX_WARNINGS]


def _properties(packet: bytes) -> Iterator[tuple[str, str]]:
    content = packet.strip(b"\0 \r\n\t")
    if b"GPano:" not in content and len(content) > _MAX_XML_BYTES:
        return
    try:
        root = fromstring(content, forbid_dtd=True) if 0 < len(content) <= _MAX_XML_BYTES else None
    except DefusedXmlException:
        return
    except (ParseError, ValueError, LookupError):
        root = None
    if root is None:
        for match in _PROPERTY.finditer(content):
            value = match[2] if match[3] is None else match[3]
            yield match[1].decode(), _clean(value.decode(errors="replace"))
        return
    for element in root.iter():
        for name, value in [*element.attrib.items(), (element.tag, element.text or "")]:
            if (match := _NAME.fullmatch(name)) is not None:
                yield match[1], _clean(value)


def _clean(value: str) -> str:
    return "".join(character for character in value.strip()[:_MAX_VALUE] if character.isprintable())
