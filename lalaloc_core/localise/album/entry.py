"""Entry of a photograph in an album: what is kept of it instead of its pixels, as a small file.

A file has 4 bytes "LLAP", the version (uint16) and the length of the header (uint32), the header in JSON, the features
as `localise.encode.features` writes them, compressed, 64 bytes of colours, and the descriptors: 16 bytes and two uint16
each, the place as shares of width and height. All numbers are little-endian. The ring of spheres is left out (zeros):
albums compare walls, not latents.
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.bundle import Bundle
from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, InvalidCorrectionError, InvalidEntryError
from lalaloc_core.localise.encode.features import MAX_BYTES, MAX_SIDE, read_features, write_features
from lalaloc_core.photograph import Photograph
from lalaloc_core.photograph.exif import MAX_NAME, Taken
from lalaloc_core.photograph.overlap import Features

MAX_ENTRY_BYTES = 20_000
_MAX_DESCRIPTORS, _DESCRIPTOR_BYTES = 256, 16
_MAX_ID = 200
_MAGIC, _VERSION, _PREFIX = b"LLAP", 1, struct.Struct("<4sHI")
_MAX_HEADER_BYTES = 4096
# A descriptor with its place.
_RECORD = np.dtype([("bits", "u1", _DESCRIPTOR_BYTES), ("place", "<u2", 2)])
_WHOLE = 2**16 - 1
# Colours: bins of each of the two axes of CIE Lab's hue plane, as OpenCV scales them, and their borders.
_HUES = 8
_BORDERS = np.array([0.0, 118.0, 122.0, 125.0, 128.0, 131.0, 134.0, 138.0, 256.0])
_THUMBNAIL = (64, 48)
COLOURS = _HUES**2
_COMPRESSION = 9
CorrectionKind = Literal["room", "position", "elsewhere", "confirmed"]


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A statement about the place of one photograph.

    Attributes:
        kind: "room": the camera is in a room, at an unknown place of it; "position": at a place, and with a heading if
            one is given; "elsewhere": in none of the rooms; "confirmed": where the pin was, as "position".
        plan_id: the plan of the room or the position.
        room_id: the room, for "room".
        x_m, y_m: the position, in the frame of the plan.
        heading_deg: heading, degrees clockwise from the plan's +y; None for an unknown one.
    """

    kind: CorrectionKind
    plan_id: str | None = None
    room_id: str | None = None
    x_m: float | None = None
    y_m: float | None = None
    heading_deg: float | None = None

    def __post_init__(self) -> None:
        given = {name for name, value in asdict(self).items() if value is not None} - {"kind"}
        needed = _FIELDS[self.kind]
        possible = needed | {"heading_deg"} if needed == _PLACE else needed
        missing, foreign = needed - given, given - possible
        if missing:
            raise InvalidCorrectionError(f"the correction '{self.kind}' needs {', '.join(sorted(missing))}")
        if foreign:
            raise InvalidCorrectionError(f"{', '.join(sorted(foreign))} does not go with the correction '{self.kind}'")
        for name, limit in (("x_m", _MAX_M), ("y_m", _MAX_M), ("heading_deg", _MAX_DEG)):
            value = getattr(self, name)
            # NaN is in no range.
            if value is not None and not abs(value) <= limit:
                raise InvalidCorrectionError(f"{name} is {value:g}; it must be between -{limit:g} and {limit:g}")

    def to_document(self) -> dict[str, Any]:
        """Return the correction as JSON."""
        return {name: value for name, value in asdict(self).items() if value is not None}


_MAX_M, _MAX_DEG = 1e5, 360.0
_PLACE = frozenset({"plan_id", "x_m", "y_m"})
_FIELDS: Mapping[str, frozenset[str]] = {
    "room": frozenset({"plan_id", "room_id"}),
    "position": _PLACE,
    "elsewhere": frozenset(),
    "confirmed": _PLACE,
}


def read_correction(document: object) -> Correction:
    """Read a correction that `to_document` wrote."""
    try:
        return build_config(Correction, document, path="correction")
    except (ConfigError, ValueError) as error:
        raise InvalidCorrectionError(str(error)[:300]) from error


@dataclass(frozen=True, eq=False)
class Descriptors:
    """Binary descriptors of corners and blobs of a photograph, the strongest first.

    Attributes:
        place: (n, 2) pixels from the top left corner, as shares of width and height.
        bits: (n, 16) descriptors of 128 bits.
    """

    place: Float[np.ndarray, "n 2"]
    bits: UInt8[np.ndarray, "n 16"]

    @classmethod
    def of(cls, features: Features) -> Descriptors:
        """Return the first descriptors of features: each value over the median of its descriptor is a one."""
        values = features.descriptor[:_MAX_DESCRIPTORS]
        if not len(values):
            return _NO_DESCRIPTORS
        ones = values > np.median(values, axis=1, keepdims=True)
        return cls(features.place[:_MAX_DESCRIPTORS], np.packbits(ones, axis=1))

    def __len__(self) -> int:
        return len(self.bits)


_NO_COLOURS = np.zeros(COLOURS, np.uint8)
_NO_DESCRIPTORS = Descriptors(np.zeros((0, 2)), np.zeros((0, _DESCRIPTOR_BYTES), np.uint8))


@dataclass(frozen=True, kw_only=True, eq=False)
class AlbumPhotograph:
    """A photograph of an album.

    Attributes:
        id: name within the album, such as the SHA-256 of the file.
        photograph: the photograph with its features instead of pixels.
        taken: time, maker, model and size in pixels; each None or empty where unknown.
        descriptors: what tells overlap with others; none for spheres, and for features that a client computed.
        colours: (64,) square roots of the shares of hues, times 255; zeros for features that a client computed.
        name: name of the file, whose numbers can tell the order; empty if unknown.
        correction: what a person stated; None without.
    """

    id: str
    photograph: Photograph
    taken: Taken = field(default=Taken())
    descriptors: Descriptors = field(default=_NO_DESCRIPTORS)
    colours: UInt8[np.ndarray, "64"] = field(default_factory=lambda: _NO_COLOURS)
    name: str = ""
    correction: Correction | None = None

    @property
    def camera_key(self) -> tuple[str, str, int, int]:
        """Maker, model and size: photographs with the same share their field of view."""
        short, long = sorted((self.taken.width, self.taken.height))
        return self.taken.make, self.taken.model, long, short

    def to_bytes(self, bundle: Bundle) -> bytes:
        """Return the entry as a file, without the name and the correction."""
        assert self.photograph.features is not None
        features = zlib.compress(
            write_features(self.photograph, self.photograph.features.outputs, bundle), _COMPRESSION
        )
        taken = self.taken
        header = _Header(
            id=self.id,
            taken_at=None if taken.at is None else taken.at.isoformat(),
            features=len(features),
            **{name: getattr(taken, name) for name in _OF_CAMERA},
        )
        text = json.dumps(dataclasses.asdict(header), allow_nan=False).encode()
        used = _PREFIX.size + len(text) + len(features) + COLOURS
        room = (MAX_ENTRY_BYTES - used) // _RECORD.itemsize
        if room < 0:
            raise InvalidEntryError(f"the entry has {used} bytes; the limit is {MAX_ENTRY_BYTES}")
        records = np.zeros(min(len(self.descriptors), room), _RECORD)
        records["bits"] = self.descriptors.bits[: len(records)]
        records["place"] = np.rint(np.clip(self.descriptors.place[: len(records)], 0.0, 1.0) * _WHOLE)
        return _PREFIX.pack(_MAGIC, _VERSION, len(text)) + text + features + self.colours.tobytes() + records.tobytes()


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Header of a file; `features` is the number of their bytes."""

    id: str
    taken_at: str | None
    make: str
    model: str
    width: int
    height: int
    features: int


_OF_CAMERA = ("make", "model", "width", "height")


def photograph_entry(id: str, photograph: Photograph, taken: Taken | None = None, name: str = "") -> AlbumPhotograph:
    """Return the entry of a photograph with features (`PhotographEncoder.with_features`, or those that a client sent).

    Its `overview` gives the descriptors; `taken` replaces the time and camera that its file states.
    """
    assert photograph.features is not None
    outputs = dict(photograph.features.outputs)
    if "ring" in outputs:
        outputs["ring"] = np.zeros_like(outputs["ring"])
    light = dataclasses.replace(
        photograph,
        features=dataclasses.replace(photograph.features, outputs=outputs),
        patches=(),
        sphere=None,
        thumbnail=None,
        overview=None,
    )
    descriptors = _NO_DESCRIPTORS if photograph.overview is None else Descriptors.of(photograph.overview.features)
    pixels = photograph.thumbnail if photograph.sphere is None else photograph.sphere
    colours = _NO_COLOURS if pixels is None else _colours(pixels)
    taken = taken or photograph.taken or Taken()
    return AlbumPhotograph(id=id, photograph=light, taken=taken, descriptors=descriptors, colours=colours, name=name)


def _colours(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "64"]:
    """Return the hues of a picture: floors, walls and curtains of a room have their own."""
    lab = cv2.cvtColor(cv2.resize(pixels, _THUMBNAIL, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB)
    across, up = (np.searchsorted(_BORDERS, lab[..., axis].ravel(), side="right") - 1 for axis in (1, 2))
    share = np.bincount(across * _HUES + up, minlength=COLOURS) / across.size
    return np.rint(255.0 * np.sqrt(share)).astype(np.uint8)


def read_entry(content: bytes, bundle: Bundle) -> AlbumPhotograph:
    """Read an entry."""
    header, body = _split(content)
    try:
        at = None if header.taken_at is None else datetime.fromisoformat(header.taken_at)
    except ValueError as error:
        raise InvalidEntryError(f"taken_at is '{header.taken_at!s:.50}', which is no time") from error
    texts = {name: getattr(header, name) for name in _OF_CAMERA[:2]}
    faults = {
        "id": not 0 < len(header.id) <= _MAX_ID or not header.id.isprintable(),
        **{name: len(text) > MAX_NAME or not text.isprintable() for name, text in texts.items()},
        "width": not 0 <= header.width <= MAX_SIDE,
        "height": not 0 <= header.height <= MAX_SIDE,
        "features": not 0 < header.features <= len(body) - COLOURS,
    }
    for name, is_wrong in faults.items():
        if is_wrong:
            raise InvalidEntryError(f"{name} of the entry is out of range")
    colours, rest = body[header.features :][:COLOURS], body[header.features + COLOURS :]
    if len(rest) % _RECORD.itemsize or len(rest) > _MAX_DESCRIPTORS * _RECORD.itemsize:
        raise InvalidEntryError(
            f"the descriptors have {len(rest)} bytes; they have {_RECORD.itemsize} each, at most {_MAX_DESCRIPTORS}"
        )
    records = np.frombuffer(rest, _RECORD)
    descriptors = Descriptors(records["place"] / _WHOLE, records["bits"].copy())
    photograph = read_features(_inflated(body[: header.features]), bundle)
    taken = Taken(at=at, **texts, width=header.width, height=header.height)
    return AlbumPhotograph(
        id=header.id,
        photograph=photograph,
        taken=taken,
        descriptors=descriptors,
        colours=np.frombuffer(colours, np.uint8).copy(),
    )


def _split(content: bytes) -> tuple[_Header, bytes]:
    if len(content) > MAX_ENTRY_BYTES:
        raise InvalidEntryError(f"the entry has {len(content)} bytes; the limit is {MAX_ENTRY_BYTES}")
    if len(content) < _PREFIX.size or not content.startswith(_MAGIC):
        raise InvalidEntryError("the file does not begin as entries do")
    _, version, length = _PREFIX.unpack_from(content)
    if version != _VERSION:
        raise InvalidEntryError(f"the entry has version {version}; this version reads {_VERSION}")
    if length > min(_MAX_HEADER_BYTES, len(content) - _PREFIX.size):
        raise InvalidEntryError(f"the header has {length} bytes; the limit is {_MAX_HEADER_BYTES}, and the rest")
    end = _PREFIX.size + length
    try:
        header = build_config(_Header, json.loads(content[_PREFIX.size : end]), path="header")
    except (ConfigError, ValueError, RecursionError) as error:
        raise InvalidEntryError(f"not a valid header: {str(error)[:300]}") from error
    return header, content[end:]


def _inflated(data: bytes) -> bytes:
    """Return the bytes of compressed features, at most one more than features may have."""
    try:
        return zlib.decompressobj().decompress(data, MAX_BYTES + 1)
    except zlib.error as error:
        raise InvalidEntryError(f"the features of the entry cannot be decompressed: {error}") from error
