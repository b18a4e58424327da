"""Picture files: checks before decoding, and decoding at a reduced size.

The header is checked before any pixel is allocated, and large pictures are scaled down in bands, so that decoding needs
little extra memory.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageChops, UnidentifiedImageError

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.file_kinds import HEIC, STAND_INS, describe_file
from lalaloc_core.photograph.exif import stated_sizes
from lalaloc_core.photograph.file_segments import (
    END,
    MAX_TEXT_BYTES,
    START,
    check_segments,
    count_scans,
    without_large_texts,
    xmp_packets,
)

FORMATS = ("JPEG", "PNG", "WEBP")
_SUPPORTED = "JPEG, PNG or WebP"
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
SIDEWAYS = {5, 6, 7, 8}
_FRONT = re.compile(r"\bfront\b", re.IGNORECASE)
_WHOLE = 0.0, 0.0, 1.0, 1.0
# Ratios of sides that differ by less (relative) are of one picture.
_SAME_RATIO = 0.01
# Largest share of rows that a JPEG without its end can lack.
_MAX_MISSING = 0.5
# Decoders raise these for damaged files; their words are not those of users.
_DAMAGE = (OSError, SyntaxError, ValueError, EOFError, RuntimeError, LookupError, OverflowError, struct.error)


@dataclass(frozen=True, kw_only=True)
class PhotographLimits:
    """Limits of photographs, checked on the file's header before its pixels are allocated.

    Attributes:
        max_scans: scans of a progressive JPEG; encoders write 3 to 12.
        min_height: pixels of the full sphere's height.
    """

    max_pixels: int = 100_000_000
    max_scans: int = 20
    min_height: int = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureFile:
    """An opened picture file.

    Attributes:
        open: returns the picture, whose pixels are not decoded yet.
        box: part of the upright picture that counts, as shares (left, top, right, bottom).
        is_upright: its pixels are upright, whatever the Exif orientation.
        is_cut: it is a JPEG whose end is missing.
        warnings: parts of the file that are damaged, or that were ignored.
    """

    open: Callable[[], Image.Image]
    kind: str | None
    size: tuple[int, int]
    exif: Image.Exif
    packets: list[bytes]
    box: tuple[float, float, float, float] = _WHOLE
    is_upright: bool = False
    is_cut: bool = False
    warnings: list[str] = field(default_factory=list)

    @property
    def orientation(self) -> int:
        """Exif orientation; 1 if there is none, or it is not to be applied."""
        orientation = 1 if self.is_upright else self.exif.get(ExifTags.Base.Orientation, 1)
        return orientation if isinstance(orientation, int) else 1

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height of the part that counts, after applying the orientation."""
        width, height = turned(self.size, self.orientation)
        left, top, right, bottom = self.box
        return round((right - left) * width), round((bottom - top) * height)


@contextmanager
def opened_picture(content: bytes, limits: PhotographLimits) -> Iterator[PictureFile]:
    """Open a JPEG, PNG, WebP or HEIC file (the first picture of several) whose pixels are not decoded yet.

    Errors of decoding within the context are translated, too.
    """
    if not content:
        raise InvalidPhotographError("the photograph is empty; if it is still in a cloud, download it first")
    _check_webp_size(content, limits)
    is_cut = check_segments(content, limits.max_scans)
    # Without its end, the decoder refuses all of the picture.
    readable, left_out = (content + END, 0) if is_cut else without_large_texts(content)
    with _named_errors(content, limits), Image.open(io.BytesIO(readable), formats=_formats(content)) as image:
        _check_pixels(*image.size, limits)
        yield _file_of(image, content, readable, left_out)


def _file_of(image: Image.Image, content: bytes, readable: bytes, left_out: int) -> PictureFile:
    """Return the picture with its metadata and what is wrong with them; `readable` is what the decoder reads."""
    size, is_cut = image.size, len(readable) > len(content)

    def opened() -> Image.Image:
        # A JPEG that was decoded at a fraction of its size is read again.
        if image.size == size:
            return image
        return Image.open(io.BytesIO(readable), formats=_formats(content))

    # A PNG can have a text of this name, which is no packet; Pillow would look for an orientation in it.
    if isinstance(image.info.get("xmp"), str):
        del image.info["xmp"]
    packets, unread = xmp_packets(content)
    packets = packets or [packet for packet in [image.info.get("xmp")] if packet]
    exif, is_damaged = _exif_of(image)
    was_turned, orientation = _was_turned(exif, packets, size), exif.get(ExifTags.Base.Orientation)
    is_animated = image.format in ("PNG", "WEBP") and getattr(image, "is_animated", False)
    unused = image.info.get("original_orientation") or 1
    is_untold = unused != 1 and b"irot" not in content and b"imir" not in content
    if is_untold:
        exif.pop(ExifTags.Base.Orientation, None)
    lens = str(exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.LensModel, ""))
    faults = {
        f"the photograph is of a front camera (Exif LensModel '{lens[:60]}'), which can save it mirrored: check that "
        "texts in it can be read, else mirror it": _FRONT.search(lens) is not None and lens.isprintable(),
        f"the Exif orientation {orientation} was ignored, because the picture was turned after it was taken: the Exif "
        "size is that of a picture on its side; send the camera's original file if this is wrong": was_turned,
        f"the Exif orientation {unused} was ignored, as HEIC pictures state their turn otherwise, and this one states "
        "none: check that the photograph is upright, else turn it in a viewer and save it": is_untold,
        "the file is animated: the first of its pictures is used": is_animated,
        "the file ends before its picture does: the missing part is grey; send the whole file": is_cut,
        f"texts of {left_out} bytes were ignored; all texts of a PNG can have {MAX_TEXT_BYTES} bytes": left_out > 0,
        f"the last {unread} XMP packets were ignored; the limit is {len(packets)}": unread > 0,
        "the Exif metadata are damaged and were ignored; send the camera's original file": is_damaged,
    }
    return PictureFile(
        open=opened,
        kind=image.format,
        size=size,
        exif=exif,
        packets=packets,
        is_upright=was_turned,
        is_cut=is_cut,
        warnings=[text for text, applies in faults.items() if applies],
    )


def _exif_of(image: Image.Image) -> tuple[Image.Exif, bool]:
    """Return the Exif metadata, empty if they are damaged, and whether they are."""
    try:
        exif = image.getexif()
        exif.get_ifd(ExifTags.IFD.Exif)
    except _DAMAGE:
        return Image.Exif(), True
    return exif, False


def _was_turned(exif: Image.Exif, packets: Sequence[bytes], size: tuple[int, int]) -> bool:
    """Return whether a picture was turned upright but kept its orientation: it has a size that is stated, turned.

    Sensors are wider than high; some cameras state the size of the upright picture.
    """
    ratios = [width / height for width, height in stated_sizes(exif, packets) if width > height]
    is_upright = size[0] < size[1] and any(abs(ratio * size[0] / size[1] - 1.0) <= _SAME_RATIO for ratio in ratios)
    return is_upright and exif.get(ExifTags.Base.Orientation) in SIDEWAYS


def _formats(content: bytes) -> tuple[str, ...]:
    """Return the formats to try; the package that reads HEIC is loaded for such files only."""
    if describe_file(content) != HEIC:
        return FORMATS
    from pi_heif import register_heif_opener

    register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)
    return ("HEIF",)


def turned(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return (width, height) after applying an EXIF orientation, or before it."""
    return (size[1], size[0]) if orientation in SIDEWAYS else size


def scaled(file: PictureFile, size: tuple[int, int], *, oversampling: int = 2) -> Image.Image:
    """Scale the part of a picture that counts to a size as RGB, and rotate it upright.

    `size` is that of the upright picture (width, height). `oversampling` is the least ratio of the decoded to the
    requested size, for pictures that are large enough.
    """
    if file.box != _WHOLE:
        return _scaled_part(file, size)
    image, stored_size = file.open(), turned(size, file.orientation)
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
    if file.is_cut:
        _check_missing(np.asarray(picture))
    turn = _UPRIGHT.get(file.orientation)
    return picture if turn is None else picture.transpose(turn)


def _scaled_part(file: PictureFile, size: tuple[int, int]) -> Image.Image:
    left, top, right, bottom = file.box
    width, height = turned(file.size, file.orientation)
    # Finer, because the borders of the part lie between pixels.
    finest = math.ceil(2.0 * size[0] / (right - left)), math.ceil(2.0 * size[1] / (bottom - top))
    picture = scaled(replace(file, box=_WHOLE), (min(width, finest[0]), min(height, finest[1])))
    pixels = left * picture.width, top * picture.height, right * picture.width, bottom * picture.height
    return picture.resize(size, Image.Resampling.BOX, box=pixels)


def jpeg(pixels: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Encode pixels as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=90)
    return buffer.getvalue()


def _check_missing(pixels: np.ndarray) -> None:
    """Refuse a picture most of whose rows are missing: the decoder fills them with one colour."""
    is_filled = (pixels == pixels[-1, -1]).all(axis=(1, 2))
    missing = (len(pixels) if is_filled.all() else int(np.argmin(is_filled[::-1]))) / len(pixels)
    if missing > _MAX_MISSING:
        raise InvalidPhotographError(
            f"the last {missing:.0%} of the photograph's rows are missing, because the file ends too early; the limit "
            f"is {_MAX_MISSING:.0%}: send the whole file"
        )


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
        image = Image.fromarray((np.asarray(image).clip(0, 65535) // 256).astype(np.uint8))
    if image.mode == "CMYK" and "adobe" not in image.info:
        # Pillow assumes that CMYK pictures are stored inverted, but only Adobe's are.
        image = ImageChops.invert(image)
    if image.has_transparency_data:
        opaque = Image.new("RGBA", image.size, (*NEUTRAL, 255))
        image = Image.alpha_composite(opaque, image.convert("RGBA"))
    return image.convert("RGB")


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
            f"the photograph has too many pixels; the limit is {limits.max_pixels} (max_pixels)"
        ) from error
    except MemoryError as error:
        raise InvalidPhotographError("there is not enough memory to decode the photograph; scale it down") from error
    except _DAMAGE as error:
        if content.startswith(START) and count_scans(content, limits.max_scans)[1]:
            raise InvalidPhotographError(
                "the photograph's file ends before its picture does, and too little of it can be decoded: send the "
                "whole file"
            ) from error
        kind = describe_file(content) or "a picture"
        # The decoder refuses more pixels than remain.
        fault = "cut to a part without being coded anew" if kind == HEIC and b"clap" in content else "damaged"
        raise InvalidPhotographError(
            f"the photograph is {kind} that is {fault}, or coded in a way that is not supported; save or export it as "
            f"{_SUPPORTED}"
        ) from error


def _unreadable(content: bytes) -> str:
    kind = describe_file(content)
    if kind in STAND_INS:
        return f"the photograph is {kind}; {STAND_INS[kind]}"
    if kind == HEIC:
        return f"the photograph is {kind}, which is damaged; save or export it as {_SUPPORTED}"
    if kind is None or kind.removeprefix("a ").removesuffix(" picture").upper() in FORMATS:
        return f"the photograph is not a readable JPEG, PNG, WebP or HEIC picture; save or export it as {_SUPPORTED}"
    return f"the photograph is {kind}, which is not supported; save or export it as {_SUPPORTED}"


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
            "(max_pixels)"
        )
