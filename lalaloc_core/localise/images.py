"""Reading panoramas: from encoded bytes to the pixels that the image encoder expects."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from lalaloc_core.errors import InvalidPanoramaError

FORMATS = ("JPEG", "PNG", "WEBP")


@dataclass(frozen=True, kw_only=True)
class PanoramaLimits:
    """What a panorama may be; checked on the file's header, before its pixels are allocated."""

    max_pixels: int = 100_000_000
    min_height: int = 64
    # Stitchers round; a picture this close to 2:1 is still a full sphere.
    aspect_tolerance: float = 0.01


def read_panorama(
    content: bytes, *, height: int, width: int, limits: PanoramaLimits | None = None
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Decode a full equirectangular JPEG, PNG or WebP and scale it to `height` x `width` RGB.

    Raises:
        InvalidPanoramaError: empty, not one of the formats, damaged, too large, or not twice as wide as high.
    """
    limits = limits or PanoramaLimits()
    if not content:
        raise InvalidPanoramaError("the panorama is empty")
    try:
        with warnings.catch_warnings():
            # Our own pixel limit, checked right below on the header, replaces Pillow's warning.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=FORMATS) as image:
                _check_header(image, limits)
                _check_aspect(*_upright_size(image), limits)
                # A JPEG can be decoded straight to a size near the wanted one.
                image.draft("RGB", (2 * width, 2 * height))
                upright = ImageOps.exif_transpose(image)
                rgb = _to_rgb(upright).resize((width, height), Image.Resampling.BOX)
    except UnidentifiedImageError as error:
        raise InvalidPanoramaError(f"the panorama is not a readable {', '.join(FORMATS)} picture") from error
    except Image.DecompressionBombError as error:
        raise InvalidPanoramaError(f"the panorama has more than {limits.max_pixels} pixels") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        if isinstance(error, InvalidPanoramaError):
            raise
        raise InvalidPanoramaError(f"the panorama is damaged: {error}") from error
    return np.asarray(rgb)


def _check_header(image: Image.Image, limits: PanoramaLimits) -> None:
    width, height = image.size
    if width * height > limits.max_pixels:
        raise InvalidPanoramaError(
            f"the panorama has {width} x {height} = {width * height} pixels, at most {limits.max_pixels} are allowed"
        )


def _upright_size(image: Image.Image) -> tuple[int, int]:
    """(width, height) once turned as its EXIF orientation says; must be asked before `draft` scales the picture."""
    width, height = image.size
    turned = image.getexif().get(ExifTags.Base.Orientation) in (5, 6, 7, 8)
    return (height, width) if turned else (width, height)


def _to_rgb(image: Image.Image) -> Image.Image:
    """8-bit RGB; Pillow's own conversion clips 16-bit grey at 255 instead of scaling it."""
    if image.mode == "I" or image.mode.startswith("I;16"):
        image = Image.fromarray((np.asarray(image).clip(0, 65535) // 256).astype(np.uint8))
    return image.convert("RGB")


def _check_aspect(width: int, height: int, limits: PanoramaLimits) -> None:
    if height < limits.min_height:
        raise InvalidPanoramaError(f"the panorama is {height} pixels high, at least {limits.min_height} are needed")
    if abs(width / height - 2.0) > 2.0 * limits.aspect_tolerance:
        raise InvalidPanoramaError(
            f"the panorama is {width} x {height}; a full 360° panorama is exactly twice as wide as high"
        )
