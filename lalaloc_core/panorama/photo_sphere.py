"""What a picture says of itself as a photo sphere: which part of the sphere it shows, and how the camera was held.

Read from the GPano properties of its XMP packet (Google's Photo Sphere XMP metadata). Nothing of it is trusted: values
out of range are ignored, and a part of the sphere that contradicts itself or the picture is reported, not used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

_NAMESPACE = "{http://ns.google.com/photos/1.0/panorama/}"
# The packet of a JPEG fits into one segment of 64 KiB; nothing that a camera writes needs more.
_MAX_XMP_BYTES = 256 * 1024
_MAX_SIDE = 1_000_000
# Stitchers round; widths, heights and their ratios this close are meant to be equal.
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
    """The part of the full sphere that a picture shows, as shares of the sphere's width (360°) and height (180°)."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True, kw_only=True)
class PhotoSphere:
    """What a picture says of itself; angles in radians.

    Attributes:
        part: the part of the sphere it shows, None for all of it, or where that is not known.
        fault: why `part` is not known although the picture speaks of it.
        refusal: why the picture is of no use, by its own account.
        pitch: how far above the horizon its centre looks.
        roll: how far the camera was turned clockwise about its viewing direction, which turns the horizon in the
            picture counterclockwise.
        compass_heading: where its centre looks, clockwise from true north; None when it does not say.
    """

    part: SpherePart | None = None
    fault: str | None = None
    refusal: str | None = None
    pitch: float = 0.0
    roll: float = 0.0
    compass_heading: float | None = None

    @property
    def level(self) -> bool:
        """Whether the camera stood upright."""
        return self.pitch == 0.0 and self.roll == 0.0


def read_photo_sphere(xmp: bytes | str | None, *, width: int, height: int) -> PhotoSphere:
    """Read the XMP packet of a picture of `width` x `height` pixels; what cannot be read says nothing."""
    values = _properties(xmp)
    projection = values.get("ProjectionType", "equirectangular")
    if projection.lower() != "equirectangular":
        return PhotoSphere(refusal=f"its projection is '{projection[:50]}', only 'equirectangular' is read")
    part, fault = _part(values, width, height)
    share = 1.0 if part is None else part.width * part.height
    if share < _MIN_SHARE:
        return PhotoSphere(refusal=f"it shows {share:.1%} of the sphere, at least {_MIN_SHARE:.0%} is needed")
    return PhotoSphere(
        part=part,
        fault=fault,
        pitch=_angle(values, "PosePitchDegrees", -90.0, 90.0) or 0.0,
        roll=_angle(values, "PoseRollDegrees", -180.0, 180.0) or 0.0,
        compass_heading=_angle(values, "PoseHeadingDegrees", 0.0, 360.0),
    )


def _properties(xmp: bytes | str | None) -> dict[str, str]:
    """The GPano properties of a packet, whether written as attributes or as elements; the first of a name counts."""
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


def _number(text: str | None) -> float | None:
    """A finite number, None for anything else."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _angle(values: dict[str, str], name: str, least: float, most: float) -> float | None:
    degrees = _number(values.get(name))
    return math.radians(degrees) if degrees is not None and least <= degrees <= most else None


def _part(values: dict[str, str], width: int, height: int) -> tuple[SpherePart | None, str | None]:
    """The part of the sphere that is shown, or what is wrong with the numbers that should tell it."""
    if not any(name in values for name in _CROP):
        return None, None
    numbers = {name: _number(values.get(name)) for name in _CROP}
    for name, number in numbers.items():
        if number is None or not 0.0 <= number <= _MAX_SIDE:
            return None, f"{name} is '{values.get(name, '')[:50]}', it must lie between 0 and {_MAX_SIDE}"
    full_width, full_height, part_width, part_height, left, top = (number or 0.0 for number in numbers.values())
    if min(full_width, full_height, part_width, part_height) < 1.0:
        return None, "it has a width or height of 0"
    if abs(full_width / full_height - 2.0) > 2.0 * _TOLERANCE:
        return None, f"its full sphere is {full_width:g} x {full_height:g}, not twice as wide as high"
    # One pixel more is rounding.
    if left + part_width > full_width + 1.0 or top + part_height > full_height + 1.0:
        return None, (
            f"the part of {part_width:g} x {part_height:g} at ({left:g}, {top:g}) does not lie within the full sphere "
            f"of {full_width:g} x {full_height:g}"
        )
    # A picture that was scaled after it was taken keeps its numbers, and their ratio.
    if abs(width / height / (part_width / part_height) - 1.0) > _TOLERANCE:
        return None, f"the part is {part_width:g} x {part_height:g}, the picture {width} x {height}"
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
