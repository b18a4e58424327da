"""Reader for panoramas: from encoded bytes to the pixels that the image encoder expects.

The header is checked before any pixel is allocated, and large pictures are scaled down in bands, so that decoding needs
little extra memory. Three kinds of metadata are used: the EXIF orientation, the visible part of the sphere, and the
camera's pitch and roll (`photo_sphere`).
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageChops, UnidentifiedImageError

from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.file_kinds import describe_file
from lalaloc_core.panorama.levelling import level
from lalaloc_core.panorama.photo_sphere import PhotoSphere, SpherePart, read_photo_sphere
from lalaloc_core.panorama.segments import check_segments, count_scans

FORMATS = ("JPEG", "PNG", "WEBP")
# Colour of missing parts of the sphere: the mean that encoders subtract.
NEUTRAL = (128, 128, 128)
# Pictures with more pixels are scaled down in bands of about this size.
_BAND_PIXELS = 2**22
# Oversampling of pictures that are placed or levelled, relative to the encoder's input.
_FINER = 2
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Rounding error, in pixels.
_EDGE = 1e-6
_SIDEWAYS = {5, 6, 7, 8}


@dataclass(frozen=True, kw_only=True)
class PanoramaLimits:
    """Limits of panoramas, checked on the file's header before its pixels are allocated.

    Attributes:
        max_pixels: width times height.
        max_scans: scans of a progressive JPEG; encoders write 3 to 12.
        min_height: pixels of the full sphere's height.
        aspect_tolerance: relative deviation of a full sphere from twice as wide as high; stitchers round.
    """

    max_pixels: int = 100_000_000
    max_scans: int = 20
    min_height: int = 64
    aspect_tolerance: float = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Panorama:
    """The full sphere, level, as the image encoder expects it.

    `compass_heading` is the azimuth of the centre column, radians clockwise from true north; None if not in the
    metadata.
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    compass_heading: float | None = None


def read_panorama(
    content: bytes, *, height: int, width: int, limits: PanoramaLimits | None = None
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Return the pixels of `open_panorama`; see there for errors."""
    return open_panorama(content, height=height, width=width, limits=limits).pixels


def open_panorama(content: bytes, *, height: int, width: int, limits: PanoramaLimits | None = None) -> Panorama:
    """Decode an equirectangular JPEG, PNG or WebP (the first picture of several) and scale it to `height` x `width`.

    Raises:
        InvalidPanoramaError: empty, unsupported format, damaged, too large, too many segments or scans, or neither the
            full sphere nor a part of it that the metadata describe.
    """
    limits = limits or PanoramaLimits()
    if not content:
        raise InvalidPanoramaError("the panorama is empty")
    _check_webp_size(content, limits)
    check_segments(content)
    with _named_errors(content, limits), Image.open(io.BytesIO(content), formats=FORMATS) as image:
        _check_pixels(*image.size, limits)
        _check_scans(content, limits)
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        upright = _turned(image.size, orientation)
        sphere = read_photo_sphere(image.info.get("xmp"), width=upright[0], height=upright[1])
        _check_shape(*upright, sphere, limits)
        finer = 1 if sphere.part is None and sphere.level else _FINER
        canvas_size = (width * finer, height * finer)
        picture = _scaled(image, orientation, _shown_size(sphere.part, canvas_size))
        canvas = picture if sphere.part is None else _placed(picture, sphere.part, canvas_size)
        if not sphere.level:
            canvas = Image.fromarray(level(np.asarray(canvas), pitch=sphere.pitch, roll=sphere.roll))
        pixels = np.asarray(canvas if finer == 1 else canvas.resize((width, height), Image.Resampling.BOX))
    return Panorama(pixels=pixels, compass_heading=sphere.compass_heading)


def warm_up(*, height: int, width: int) -> None:
    """Read a small picture of every format, so that codecs are loaded before the first request."""
    picture = Image.new("RGB", (256, 128), NEUTRAL)
    for picture_format in FORMATS:
        buffer = io.BytesIO()
        picture.save(buffer, picture_format)
        open_panorama(buffer.getvalue(), height=height, width=width)


@contextmanager
def _named_errors(content: bytes, limits: PanoramaLimits) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            # `_check_pixels` replaces Pillow's size warning; damaged metadata are harmless.
            warnings.simplefilter("ignore")
            yield
    except InvalidPanoramaError:
        raise
    except UnidentifiedImageError as error:
        raise InvalidPanoramaError(_unreadable(content)) from error
    except Image.DecompressionBombError as error:
        raise InvalidPanoramaError(
            f"the panorama has too many pixels; the limit is {limits.max_pixels} (LALALOC_MAX_PIXELS)"
        ) from error
    except MemoryError as error:
        raise InvalidPanoramaError("there is not enough memory to decode the panorama; scale it down") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise InvalidPanoramaError(f"the panorama is damaged: {error}") from error


def _unreadable(content: bytes) -> str:
    formats = f"{', '.join(FORMATS[:-1])} or {FORMATS[-1]}"
    kind = describe_file(content)
    if kind is None or any(name in kind.upper() for name in FORMATS):
        return f"the panorama is not a readable {formats} picture"
    return f"the panorama is {kind}, which is not supported; save or export it as {formats}"


def _check_webp_size(content: bytes, limits: PanoramaLimits) -> None:
    """Check a WebP's header first: its decoder allocates the canvas when it is opened."""
    if content[:4] != b"RIFF" or content[8:12] != b"WEBP" or len(content) < 30:
        return
    kind, head = content[12:16], content[20:30]
    if kind == b"VP8X":
        size = int.from_bytes(head[4:7], "little") + 1, int.from_bytes(head[7:10], "little") + 1
    elif kind == b"VP8L":
        bits = int.from_bytes(head[1:5], "little")
        size = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        size = int.from_bytes(head[6:8], "little") & 0x3FFF, int.from_bytes(head[8:10], "little") & 0x3FFF
    _check_pixels(*size, limits)


def _check_pixels(width: int, height: int, limits: PanoramaLimits) -> None:
    if width * height > limits.max_pixels:
        raise InvalidPanoramaError(
            f"the panorama has {width} x {height} = {width * height} pixels; the limit is {limits.max_pixels} "
            "(LALALOC_MAX_PIXELS)"
        )


def _check_scans(content: bytes, limits: PanoramaLimits) -> None:
    """Refuse JPEGs with many scans; each visits all pixels again."""
    if count_scans(content, limits.max_scans) > limits.max_scans:
        raise InvalidPanoramaError(
            f"the panorama is a JPEG with more than {limits.max_scans} scans, the limit (LALALOC_MAX_SCANS); "
            "save it again"
        )


def _check_shape(width: int, height: int, sphere: PhotoSphere, limits: PanoramaLimits) -> None:
    if sphere.refusal is not None:
        raise InvalidPanoramaError(f"the panorama's photo sphere metadata rule it out: {sphere.refusal}")
    full_height = height if sphere.part is None else round(height / sphere.part.height)
    if full_height < limits.min_height:
        raise InvalidPanoramaError(f"the panorama is {full_height} pixels high; the minimum is {limits.min_height}")
    if sphere.part is None and abs(width / height - 2.0) > 2.0 * limits.aspect_tolerance:
        fault = "" if sphere.fault is None else f"; its photo sphere metadata are invalid: {sphere.fault}"
        raise InvalidPanoramaError(
            f"the panorama is {width} x {height}; a full 360° panorama is twice as wide as high, within "
            f"{limits.aspect_tolerance:.0%}{fault}"
        )


def _turned(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return (width, height) after applying an EXIF orientation, or before it."""
    return (size[1], size[0]) if orientation in _SIDEWAYS else size


def _shown_size(part: SpherePart | None, canvas_size: tuple[int, int]) -> tuple[int, int]:
    """Return the size to scale a picture of a part of the sphere to, at least as fine as the canvas."""
    width, height = canvas_size
    return (width, height) if part is None else (math.ceil(width * part.width), math.ceil(height * part.height))


def _scaled(image: Image.Image, orientation: int, size: tuple[int, int]) -> Image.Image:
    """Scale the whole picture to a size as RGB, and rotate it upright."""
    stored_size = _turned(size, orientation)
    # JPEGs can be decoded directly at a fraction of their size.
    image.draft("RGB", (2 * stored_size[0], 2 * stored_size[1]))
    width, height = image.size
    factor = max(1, min(width // (2 * stored_size[0]), height // (2 * stored_size[1])))
    if width * height <= _BAND_PIXELS or factor == 1:
        scaled = _to_rgb(image).resize(stored_size, Image.Resampling.BOX)
    else:
        # The box accounts for a partial last block in rows and columns.
        box = (0.0, 0.0, width / factor, height / factor)
        scaled = _reduced(image, factor).resize(stored_size, Image.Resampling.BOX, box=box)
    turn = _UPRIGHT.get(orientation)
    return scaled if turn is None else scaled.transpose(turn)


def _reduced(image: Image.Image, factor: int) -> Image.Image:
    """Scale the picture down by `factor` as RGB, in bands: a copy of the whole would double its memory."""
    width, height = image.size
    rows = factor * max(1, _BAND_PIXELS // width // factor)
    reduced = Image.new("RGB", (-(-width // factor), -(-height // factor)))
    for top in range(0, height, rows):
        band = _to_rgb(image.crop((0, top, width, min(top + rows, height))))
        reduced.paste(band.reduce(factor), (0, top // factor))
    return reduced


def _to_rgb(image: Image.Image) -> Image.Image:
    """Convert to 8-bit RGB; 16-bit grey is scaled (Pillow would clip it), transparent pixels become neutral."""
    if image.mode == "I" or image.mode.startswith("I;16"):
        image = _eight_bit(image)
    if image.mode == "CMYK" and "adobe" not in image.info:
        # Pillow assumes that CMYK pictures are stored inverted, but only Adobe's are.
        image = ImageChops.invert(image)
    if image.has_transparency_data:
        opaque = Image.new("RGBA", image.size, (*NEUTRAL, 255))
        image = Image.alpha_composite(opaque, image.convert("RGBA"))
    return image.convert("RGB")


def _eight_bit(image: Image.Image) -> Image.Image:
    values = np.asarray(image)
    grey = Image.fromarray((values.clip(0, 65535) // 256).astype(np.uint8))
    transparent = image.info.get("transparency")
    if not isinstance(transparent, int):
        return grey
    opacity = np.where(values == transparent, 0, 255).astype(np.uint8)
    return Image.merge("LA", (grey, Image.fromarray(opacity)))


def _placed(picture: Image.Image, part: SpherePart, size: tuple[int, int]) -> Image.Image:
    """Place a picture of a part on the neutral full sphere; pixels that it covers partly stay neutral."""
    width, height = size
    edges_x = (part.left * width, (part.left + part.width) * width)
    edges_y = (part.top * height, (part.top + part.height) * height)
    left, right = math.ceil(edges_x[0] - _EDGE), math.floor(edges_x[1] + _EDGE)
    top, bottom = math.ceil(edges_y[0] - _EDGE), math.floor(edges_y[1] + _EDGE)
    scale_x = picture.width / (edges_x[1] - edges_x[0])
    scale_y = picture.height / (edges_y[1] - edges_y[0])
    box = (
        max(0.0, (left - edges_x[0]) * scale_x),
        max(0.0, (top - edges_y[0]) * scale_y),
        min(float(picture.width), (right - edges_x[0]) * scale_x),
        min(float(picture.height), (bottom - edges_y[0]) * scale_y),
    )
    canvas = Image.new("RGB", size, NEUTRAL)
    canvas.paste(picture.resize((right - left, bottom - top), Image.Resampling.BILINEAR, box=box), (left, top))
    return canvas
