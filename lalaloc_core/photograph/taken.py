"""Time and camera of a photograph by its EXIF metadata, without its position or owner."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from PIL import ExifTags, Image

from lalaloc_core.photograph.picture_files import PhotographLimits, opened_picture

MAX_NAME = 60
_FORMAT = "%Y:%m:%d %H:%M:%S"
_TIMES = (
    (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal),
    (ExifTags.Base.DateTimeDigitized, ExifTags.Base.SubsecTimeDigitized),
)


@dataclass(frozen=True, kw_only=True)
class Taken:
    """Time and camera of a photograph; None, empty or 0 for what is unknown.

    Attributes:
        at: time by the camera's clock, without a time zone.
        make, model: maker and model of the camera.
        width, height: size of the upright picture, pixels.
    """

    at: datetime | None = None
    make: str = ""
    model: str = ""
    width: int = 0
    height: int = 0


def read_taken(content: bytes, limits: PhotographLimits | None = None) -> Taken:
    """Read time and camera of a picture file.

    Raises:
        InvalidPhotographError: the file is not readable or too large.
    """
    with opened_picture(content, limits or PhotographLimits()) as file:
        width, height = file.upright_size
        make, model = (_text(file.exif.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
        return Taken(at=_time(file.exif), make=make, model=model, width=width, height=height)


def _time(exif: Image.Exif) -> datetime | None:
    """Return when a photograph was taken; the time of the file's last change is not used."""
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    for tag, subseconds in _TIMES:
        try:
            at = datetime.strptime(_text(tags.get(tag)), _FORMAT)
        except ValueError:
            continue
        digits = _text(tags.get(subseconds))[:6]
        return at.replace(microsecond=int(digits.ljust(6, "0"))) if digits.isascii() and digits.isdigit() else at
    return None


def _text(value: object) -> str:
    """Return a text of the metadata as it is printed, empty if there is none."""
    text = "" if value is None else str(value)[: 2 * MAX_NAME]
    return "".join(filter(str.isprintable, text)).strip()[:MAX_NAME]
