"""Photographs with the faults that people's files have, and the answer or refusal that each must get.

Tests of HTTP, the client, the command line and the page walk this table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "faults"
# Words of libraries, of their objects and of Python, which no message has.
LIBRARY_WORDS = (
    *("PIL", "illow", "libheif", "BytesIO", " at 0x", "bomb", "MAX_TEXT", "Traceback", "plugin", "not a TIFF"),
    *("numpy", "sqlalchemy", "sqlite3", "pydantic", "starlette", "asyncio", "cv2", "ezdxf", "lxml", "ifcopenshell"),
)
# A lower confidence needs a warning.
LOW_CONFIDENCE = 0.1


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A file with a fault.

    Attributes:
        name: its name in `FOLDER`.
        fields: fields of the request beside the photograph.
        room, x_m, y_m, heading_deg: the right answer; no room for a photograph that cannot be used.
        said: a part of a warning, or of the refusal; None for an answer without.
        within_m: largest error of the position.
    """

    name: str
    fields: Mapping[str, str] = field(default_factory=dict)
    room: str | None = "kitchen"
    x_m: float = 7.1
    y_m: float = 2.2
    heading_deg: float = 250.0
    said: str | None = None
    within_m: float = 0.3

    @property
    def content(self) -> bytes:
        return (FOLDER / self.name).read_bytes()

    @property
    def is_usable(self) -> bool:
        """True if the file can be localised."""
        return self.room is not None

    def check(self, answer: Mapping[str, Any]) -> None:
        """Check an answer of a search with the shipped model, or a pose of several, as a document."""
        place = answer["position"]
        assert answer["room"] == self.room, answer
        assert math.hypot(place["x_m"] - self.x_m, place["y_m"] - self.y_m) < self.within_m, answer
        assert abs((answer["heading_deg"] - self.heading_deg + 180.0) % 360.0 - 180.0) < 6.0, answer
        self.check_warnings(answer)

    def check_warnings(self, answer: Mapping[str, Any]) -> None:
        """Check that an answer's warnings say what was assumed, and why its confidence is low."""
        warnings = answer["warnings"]
        confidence = answer.get("confidence", answer.get("probability"))
        assert warnings or (confidence is not None and confidence >= LOW_CONFIDENCE), answer
        assert self.said is None or any(self.said in text for text in warnings), warnings
        assert not any(word in text for word in LIBRARY_WORDS for text in warnings), warnings

    def check_refusal(self, text: str) -> None:
        assert self.said is not None
        assert self.said in text, text
        assert not any(word in text for word in LIBRARY_WORDS), text


_LIVING = {"room": "living room", "x_m": 2.15, "y_m": 2.3, "heading_deg": 30.0}
_TURNED = {"room": "living room", "x_m": 2.15, "y_m": 2.3, "heading_deg": 335.0}
_CORNER = {"room": "living room", "x_m": 3.0, "y_m": 1.54, "heading_deg": 335.0}
_SMALL = '{"fx":232.4,"fy":232.4,"cx":319.5,"cy":239.5}'
_SIDEWAYS = '{"fx":581,"fy":581,"cx":799.5,"cy":599.5}'
FAULTS = (
    Fault(name="crop_half.jpg", said="was cropped after it was taken", within_m=0.5, **_CORNER),
    Fault(name="crop_over_seam.jpg", room=None, said="(800, 100) is not within the full sphere of 1024 x 512"),
    Fault(name="cube_3x2.jpg", room=None, said="a cube map, 3 x 2 faces: convert it to equirectangular"),
    Fault(name="cylinder_full_is_crop.jpg", room=None, said="the borders do not continue each other; state hfov_deg"),
    Fault(name="dual_fisheye.jpg", room=None, said="dual fisheye picture of a 360° camera"),
    Fault(name="film.jpg", room=None, said="is a video; send a film of a turn as a film"),
    Fault(name="front_camera.jpg", said="of a front camera (Exif LensModel 'iPhone 13 front camera 2.71mm f/2.2')"),
    Fault(name="gopro_wide.jpg", said="GoPro HERO5 Black has a fisheye lens of about 123°"),
    Fault(name="heic_clap.heic", room=None, said="is a HEIC picture that is cut to a part without being coded anew"),
    Fault(name="heif_av1.heic", room=None, said="is an AVIF picture, which is not supported"),
    Fault(name="intrinsics_other_size.jpg", fields={"intrinsics": _SMALL}, said="were scaled by 2.5"),
    Fault(name="intrinsics_portrait.jpg", fields={"intrinsics": _SIDEWAYS}, said="a picture on its side", **_LIVING),
    Fault(name="jpeg_no_eoi.jpg", said="the file ends before its picture does"),
    Fault(name="partial_heading.jpg", fields={"heading_deg": "210.6"}, heading_deg=210.6),
    Fault(name="png_big_metadata.png", said="texts of 1611 bytes were ignored"),
    Fault(name="screenshot_bars.jpg", said="is within bars, 65% of the picture", **_CORNER),
    Fault(name="sphere_letterbox.jpg", said="a sphere with bars at its borders"),
    Fault(name="sphere_orientation6.jpg", said="the Exif orientation 6, which is ignored"),
    Fault(name="stale_orientation.jpg", said="because the picture was turned after it was taken", **_TURNED),
    Fault(name="stereo_top_bottom.jpg", room=None, said="a stereo sphere, one eye above the other: cut out one"),
    Fault(name="two_xmp.jpg"),
)
# Intrinsics of another size without an optical centre cannot be scaled, but contradict EXIF.
CONTRADICTED = Fault(
    name="intrinsics_other_size.jpg", fields={"intrinsics": '{"fx":1452.5,"fy":1452.5}'}, said="is 58°, and the EXIF"
)


def fault_id(fault: Fault) -> str:
    return Path(fault.name).stem
