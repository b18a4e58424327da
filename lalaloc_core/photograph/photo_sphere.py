"""Photo Sphere metadata: visible part of the sphere, pitch, roll and compass heading.

Read from the GPano properties of a picture's XMP packet (Google's Photo Sphere XMP metadata). The values are not
trusted: values out of range are ignored, and a contradictory part of the sphere is reported and not used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from lalaloc_core.photograph.exif import finite_number

_NAMESPACE = "{http://ns.google.com/photos/1.0/panorama/}"
# A packet of a JPEG fits into one segment of 64 KiB.
_MAX_XMP_BYTES = 256 * 1024
_MAX_SIDE = 1_000_000
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


@dataclass(frozen=True, kw_only=True)
class SpherePart:
    """The visible part of the full sphere, as shares of its width (360°) and height (180°)."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True, kw_only=True)
class PhotoSphere:
    """Photo Sphere metadata of a picture; angles in radians.

    Attributes:
        part: visible part of the sphere, None for all of it or if unknown.
        fault: problem with the metadata of `part`, None if they are valid or missing.
        refusal: reason that the metadata rule the picture out as a sphere, None if they do not.
        declared: the metadata state that the picture shows a sphere or a part of it.
        cylinder: horizontal field of view of a picture that the metadata state to be cylindrical; None if they do not.
        roll: clockwise rotation of the camera about its viewing direction; the horizon rotates counterclockwise.
        compass_heading: azimuth of the centre, clockwise from true north; None if missing.
    """

    part: SpherePart | None = None
    fault: str | None = None
    refusal: str | None = None
    declared: bool = False
    cylinder: float | None = None
    pitch: float = 0.0
    roll: float = 0.0
    compass_heading: float | None = None

    @property
    def level(self) -> bool:
        """True if pitch and roll are zero."""
        return self.pitch == 0.0 and self.roll == 0.0


def read_photo_sphere(xmp: bytes | str | None, *, width: int, height: int) -> PhotoSphere:
    """Read the XMP packet of a picture of `width` x `height` pixels; unreadable packets count as missing."""
    values = _properties(xmp)
    projection = values.get("ProjectionType", "equirectangular")
    if projection.lower() != "equirectangular":
        return PhotoSphere(
            refusal=f"the projection is '{projection[:50]}'; only 'equirectangular' is supported",
            cylinder=_cylinder(values) if projection.lower() == "cylindrical" else None,
        )
    part, fault = _part(values, width, height)
    share = 1.0 if part is None else part.width * part.height
    if share < _MIN_SHARE:
        return PhotoSphere(refusal=f"it shows {share:.1%} of the sphere; the minimum is {_MIN_SHARE:.0%}")
    return PhotoSphere(
        part=part,
        fault=fault,
        declared="ProjectionType" in values or any(name in values for name in _CROP),
        pitch=_angle(values, "PosePitchDegrees", -90.0, 90.0) or 0.0,
        roll=_angle(values, "PoseRollDegrees", -180.0, 180.0) or 0.0,
        compass_heading=_angle(values, "PoseHeadingDegrees", 0.0, 360.0),
    )


def _properties(xmp: bytes | str | None) -> dict[str, str]:
    """Return the GPano properties of a packet, from attributes and elements; the first of each name counts."""
    if not xmp or len(xmp) > _MAX_XMP_BYTES:
        return {}
    packet = xmp.strip("\0 \r\n\t") if isinstance(xmp, str) else xmp.strip(b"\0 \r\n\t")
    try:
        root = fromstring(packet, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError):
        return {}
    found: dict[str, str] = {}
    for element in root.iter():
        for name, value in [*element.attrib.items(), (element.tag, element.text or "")]:
            if name.startswith(_NAMESPACE):
                found.setdefault(name.removeprefix(_NAMESPACE), value.strip())
    return found


def _angle(values: dict[str, str], name: str, low_deg: float, high_deg: float) -> float | None:
    degrees = finite_number(values.get(name))
    return math.radians(degrees) if degrees is not None and low_deg <= degrees <= high_deg else None


def _cylinder(values: dict[str, str]) -> float | None:
    """Return the angle that a part of a cylinder shows."""
    full, part = (finite_number(values.get(name)) for name in ("FullPanoWidthPixels", "CroppedAreaImageWidthPixels"))
    return math.tau * part / full if full and part and 0.0 < part <= full else None


def _part(values: dict[str, str], width: int, height: int) -> tuple[SpherePart | None, str | None]:
    """Return the visible part of the sphere, or the problem with its metadata."""
    if not any(name in values for name in _CROP):
        return None, None
    numbers = {name: finite_number(values.get(name)) for name in _CROP}
    for name, number in numbers.items():
        if number is None or not 0.0 <= number <= _MAX_SIDE:
            return None, f"{name} is '{values.get(name, '')[:50]}'; it must be between 0 and {_MAX_SIDE}"
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
