"""Picture files: checks before decoding, and decoding at a reduced size.

The header is checked before any pixel is allocated, and large pictures are scaled down in bands, so that decoding needs
little extra memory.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from PIL import ExifTags, Image, ImageChops, UnidentifiedImageError

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.file_kinds import HEIC, describe_file
from lalaloc_core.photograph.file_segments import check_segments, count_scans

FORMATS = ("JPEG", "PNG", "WEBP")
# Colour of missing parts of the sphere: the mean that encoders subtract.
NEUTRAL = (128, 128, 128)
# Pictures with more pixels are scaled down in bands of about this size.
_BAND_PIXELS = 2**22
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_SIDEWAYS = {5, 6, 7, 8}


@dataclass(frozen=True, kw_only=True)
class PhotographLimits:
    """Limits of photographs, checked on the file's header before its pixels are allocated.

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


@contextmanager
def opened_picture(content: bytes, limits: PhotographLimits) -> Iterator[Image.Image]:
    """Open a JPEG, PNG, WebP or HEIC file (the first picture of several) whose pixels are not decoded yet.

    Errors of decoding within the context are translated, too.

    Raises:
        InvalidPhotographError: empty, unsupported format, damaged, too large, too many segments or scans.
    """
    if not content:
        raise InvalidPhotographError("the photograph is empty")
    _check_webp_size(content, limits)
    check_segments(content)
    with _named_errors(content, limits), Image.open(io.BytesIO(content), formats=_formats(content)) as image:
        _check_pixels(*image.size, limits)
        _check_scans(content, limits)
        yield image


def orientation_of(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 if there is none."""
    return image.getexif().get(ExifTags.Base.Orientation, 1)


def _formats(content: bytes) -> tuple[str, ...]:
    """Return the formats to try; the package that reads HEIC is loaded for such files only."""
    if describe_file(content) != HEIC:
        return FORMATS
    try:
        from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports]
    except ImportError:
        return FORMATS
    register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)
    return ("HEIF",)


def turned(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return (width, height) after applying an EXIF orientation, or before it."""
    return (size[1], size[0]) if orientation in _SIDEWAYS else size


def scaled(image: Image.Image, orientation: int, size: tuple[int, int], *, oversampling: int = 2) -> Image.Image:
    """Scale the whole picture to a size as RGB, and rotate it upright.

    Args:
        image: picture of `opened_picture`.
        orientation: its EXIF orientation.
        size: width and height of the upright picture.
        oversampling: least ratio of the decoded to the requested size, for pictures that are large enough.
    """
    stored_size = turned(size, orientation)
    # JPEGs can be decoded directly at a fraction of their size.
    image.draft("RGB", (oversampling * stored_size[0], oversampling * stored_size[1]))
    width, height = image.size
    factor = max(1, min(width // (2 * stored_size[0]), height // (2 * stored_size[1])))
    if width * height <= _BAND_PIXELS or factor == 1:
        picture = _to_rgb(image).resize(stored_size, Image.Resampling.BOX)
    else:
        # The box accounts for a partial last block in rows and columns.
        box = (0.0, 0.0, width / factor, height / factor)
        picture = _reduced(image, factor).resize(stored_size, Image.Resampling.BOX, box=box)
    turn = _UPRIGHT.get(orientation)
    return picture if turn is None else picture.transpose(turn)


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


@contextmanager
def _named_errors(content: bytes, limits: PhotographLimits) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            # `_check_pixels` replaces Pillow's size warning; damaged metadata are harmless.
            warnings.simplefilter("ignore")
            yield
    except InvalidPhotographError:
        raise
    except UnidentifiedImageError as error:
        raise InvalidPhotographError(_unreadable(content)) from error
    except Image.DecompressionBombError as error:
        raise InvalidPhotographError(
            f"the photograph has too many pixels; the limit is {limits.max_pixels} (LALALOC_MAX_PIXELS)"
        ) from error
    except MemoryError as error:
        raise InvalidPhotographError("there is not enough memory to decode the photograph; scale it down") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise InvalidPhotographError(f"the photograph is damaged: {error}") from error


def _unreadable(content: bytes) -> str:
    formats = f"{', '.join(FORMATS[:-1])} or {FORMATS[-1]}"
    kind = describe_file(content)
    if kind == HEIC:
        missing = find_spec("pillow_heif") is None
        fault = "which needs the extra `heic` on the server" if missing else "which is damaged"
        return f"the photograph is {kind}, {fault}; save or export it as {formats}"
    if kind is None or any(name in kind.upper() for name in FORMATS):
        return f"the photograph is not a readable {formats} picture"
    return f"the photograph is {kind}, which is not supported; save or export it as {formats}"


def _check_webp_size(content: bytes, limits: PhotographLimits) -> None:
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


def _check_pixels(width: int, height: int, limits: PhotographLimits) -> None:
    if width * height > limits.max_pixels:
        raise InvalidPhotographError(
            f"the photograph has {width} x {height} = {width * height} pixels; the limit is {limits.max_pixels} "
            "(LALALOC_MAX_PIXELS)"
        )


def _check_scans(content: bytes, limits: PhotographLimits) -> None:
    """Refuse JPEGs with many scans; each visits all pixels again."""
    if count_scans(content, limits.max_scans) > limits.max_scans:
        raise InvalidPhotographError(
            f"the photograph is a JPEG with more than {limits.max_scans} scans, the limit (LALALOC_MAX_SCANS); "
            "save it again"
        )
