"""What is sent: requests as plain data, the same bytes every time they are sent."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import os
import re
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import httpx

from lalaloc_client.retry import Safety

if TYPE_CHECKING:
    from PIL.Image import Image

Document = Mapping[str, Any] | bytes | str | os.PathLike[str]
Refine = Literal["none", "vdr", "lpo"]
Picture = Literal["both", "plan", "photograph"]
PictureFormat = Literal["png", "svg"]
SequenceRefine = Literal["none", "lpo"]
Covariance = tuple[tuple[float, float], tuple[float, float]]

_JSON, _FILE = "application/json", "application/octet-stream"
_JPEG_QUALITY = 95
_PICTURE_MEDIA: Mapping[PictureFormat, str] = {"png": "image/png", "svg": "image/svg+xml"}
_ID = re.compile(r"[A-Za-z0-9_-]{1,128}")


class QueryOptions(TypedDict, total=False):
    """What may be said of a query, as `Client.localise` takes it."""

    heading_deg: float | None
    heading_tolerance_deg: float | None
    camera_height_m: float | None
    camera_height_std_m: float | None
    near: Mapping[str, float] | None
    radius_m: float | None
    rooms: Sequence[str] | None
    strict: bool | None
    refine: Refine | None
    top_k: int | None


@dataclass(frozen=True)
class Request:
    """One request to the service.

    Attributes:
        params: of the URL; a list is given once for each of its items.
        safety: what sending it twice may do.
        answers: statuses that are an answer, and not a failure.
        streamed: whether the answer is read as it comes, and may last.
    """

    method: str
    path: str
    params: Mapping[str, str | list[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes = b""
    safety: Safety = Safety.ANY
    answers: frozenset[int] = frozenset({200, 201, 204})
    streamed: bool = False


def upload_request(document: Document, options: Mapping[str, object] | None, idempotency_key: str | None) -> Request:
    """Store a plan; the key lets the service see that a second one is the same request."""
    media, content = _plan_body(document, options)
    headers = {"Content-Type": media, "Idempotency-Key": idempotency_key or uuid.uuid4().hex}
    return Request("POST", "/floorplans", headers=headers, content=content)


def replace_request(
    floorplan_id: str, document: Document, options: Mapping[str, object] | None, if_match: str | None
) -> Request:
    """Store a new revision of a plan; with `if_match` a second one would be refused, though the first was done."""
    media, content = _plan_body(document, options)
    headers = {"Content-Type": media}
    if if_match is not None:
        headers["If-Match"] = if_match
    safety = Safety.ANY if if_match is None else Safety.UNSENT
    return Request("PUT", _plan_path(floorplan_id), headers=headers, content=content, safety=safety)


def export_request(floorplan_id: str, file_format: str) -> Request:
    """A plan as the file of another tool."""
    return Request("GET", f"{_plan_path(floorplan_id)}/export", {"format": file_format})


def plan_request(floorplan_id: str) -> Request:
    """Look at a plan."""
    return Request("GET", _plan_path(floorplan_id))


def original_request(floorplan_id: str) -> Request:
    """The file that a plan was uploaded as."""
    return Request("GET", f"{_plan_path(floorplan_id)}/original")


def preview_request(
    floorplan_id: str,
    *,
    x_m: float | None,
    y_m: float | None,
    heading_deg: float | None,
    covariance_m2: Covariance | None,
) -> Request:
    """A drawing of a plan, with a camera in it where its position is given.

    Raises:
        ValueError: half a position, or a heading or a covariance without one; or a number that is not finite.
    """
    if (x_m is None) != (y_m is None):
        raise ValueError(f"x_m is {x_m} and y_m is {y_m}, they belong together")
    if x_m is None and not (heading_deg is None and covariance_m2 is None):
        raise ValueError("heading_deg and covariance_m2 need a position, x_m and y_m")
    _check_finite({"x_m": x_m, "y_m": y_m, "heading_deg": heading_deg})
    given = {"x_m": x_m, "y_m": y_m, "heading_deg": heading_deg}
    params: dict[str, str | list[str]] = {name: str(value) for name, value in given.items() if value is not None}
    if covariance_m2 is not None:
        (xx, xy), (_, yy) = covariance_m2
        _check_finite({"covariance_m2 (xx)": xx, "covariance_m2 (xy)": xy, "covariance_m2 (yy)": yy})
        params["covariance_m2"] = [str(xx), str(xy), str(yy)]
    headers = {"Accept": "image/svg+xml"}
    return Request("GET", f"{_plan_path(floorplan_id)}/preview.svg", params=params, headers=headers)


def layout_request(floorplan_id: str, revision: str | None) -> Request:
    """The walls of a plan, room by room."""
    params = {} if revision is None else {"revision": revision}
    return Request("GET", f"{_plan_path(floorplan_id)}/layout", params)


def answer_request(answer_id: str, method: Literal["GET", "DELETE"] = "GET") -> Request:
    """An answer that the service keeps, to be told again or forgotten."""
    return Request(method, resource_path("answers", "answer_id", answer_id))


def mesh_request(floorplan_id: str) -> Request:
    """A mesh of a plan."""
    return Request("GET", f"{_plan_path(floorplan_id)}/mesh.glb", headers={"Accept": "model/gltf-binary"})


def events_request(floorplan_id: str) -> Request:
    """How far a plan is, told as it happens."""
    headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
    return Request("GET", f"{_plan_path(floorplan_id)}/events", headers=headers, streamed=True)


def delete_request(floorplan_id: str) -> Request:
    """Delete a plan."""
    return Request("DELETE", _plan_path(floorplan_id))


def page_request(name: str | None, limit: int, cursor: str | None) -> Request:
    """One page of the stored plans."""
    given = {"name": name, "limit": str(limit), "cursor": cursor}
    return Request("GET", "/floorplans", {key: value for key, value in given.items() if value is not None})


def localise_request(
    floorplan_id: str | None,
    panorama: bytes | str | os.PathLike[str] | Image,
    *,
    heading_deg: float | None = None,
    heading_tolerance_deg: float | None = None,
    camera_height_m: float | None = None,
    camera_height_std_m: float | None = None,
    refine: Refine | None = None,
    top_k: int | None = None,
    near: Mapping[str, float] | None = None,
    radius_m: float | None = None,
    rooms: Sequence[str] | None = None,
    strict: bool | None = None,
    posterior: bool = False,
    venue_id: str | None = None,
    level: float | None = None,
) -> Request:
    """A query about a plan or a venue; it stores nothing, so asking twice is as good as once."""
    given = {
        "floorplan_id": floorplan_id,
        "venue_id": venue_id,
        "heading_deg": heading_deg,
        "heading_tolerance_deg": heading_tolerance_deg,
        "camera_height_m": camera_height_m,
        "camera_height_std_m": camera_height_std_m,
        "refine": refine,
        "top_k": top_k,
        "radius_m": radius_m,
        "strict": strict,
        "include": "posterior" if posterior else None,
        "level": level,
        "near": None if near is None else json.dumps(dict(near)),
        # Text alone would be taken for a room by each of its letters.
        "rooms": None if rooms is None else json.dumps([rooms] if isinstance(rooms, str) else list(rooms)),
    }
    _check_finite({**given, **{f"near['{name}']": value for name, value in (near or {}).items()}})
    return _query("/localise", given, [panorama])


def geopose_request(
    panorama: bytes | str | os.PathLike[str] | Image,
    *,
    floorplan_id: str | None,
    venue_id: str | None,
    latitude: float | None,
    longitude: float | None,
    accuracy_m: float | None,
) -> Request:
    """A request of the OSCP GeoPose protocol.

    Raises:
        ValueError: half a place, or an accuracy without one; or a number that is not finite.
    """
    if (latitude is None) != (longitude is None):
        raise ValueError(f"latitude is {latitude} and longitude is {longitude}, they belong together")
    if latitude is None and accuracy_m is not None:
        raise ValueError("accuracy_m needs a place, latitude and longitude")
    _check_finite({"latitude": latitude, "longitude": longitude, "accuracy_m": accuracy_m})
    now_ms = time.time_ns() // 1_000_000
    privacy = {
        f"data{what}": [] for what in ("Retention", "AcceptableUse", "SanitizationApplied", "SanitizationRequested")
    }
    common = {"timestamp": now_ms, "privacy": privacy}
    picture = base64.b64encode(_picture(panorama)).decode("ascii")
    # The size of a file is in the file.
    camera = {"sensorId": "camera", "sequenceNumber": 0, "imageFormat": "JPG", "size": [], "imageBytes": picture}
    sensors, readings = [{"id": "camera", "type": "camera"}], {"cameraReadings": [common | camera]}
    if latitude is not None:
        place = {"sensorId": "place", "latitude": latitude, "longitude": longitude, "accuracy": accuracy_m or 0.0}
        sensors.append({"id": "place", "type": "geolocation"})
        readings["geolocationReadings"] = [common | place]
    asked = {"id": uuid.uuid4().hex, "timestamp": now_ms, "type": "geopose", "sensors": sensors}
    given = {"floorplan_id": floorplan_id, "venue_id": venue_id}
    params = {name: value for name, value in given.items() if value is not None}
    content = json.dumps(asked | {"sensorReadings": readings}).encode()
    return Request("POST", "/geopose", params, {"Content-Type": _JSON}, content)


def sequence_request(
    floorplan_id: str,
    panoramas: Sequence[bytes | str | os.PathLike[str] | Image],
    *,
    motions: Sequence[Mapping[str, float] | None] | None,
    headings_deg: Sequence[float | None] | None,
    heading_tolerance_deg: float | None,
    camera_height_m: float | None,
    camera_height_std_m: float | None,
    refine: SequenceRefine | None,
    top_k: int | None,
) -> Request:
    """A query of several panoramas."""
    given = {
        "floorplan_id": floorplan_id,
        "heading_tolerance_deg": heading_tolerance_deg,
        "camera_height_m": camera_height_m,
        "camera_height_std_m": camera_height_std_m,
        "refine": refine,
        "top_k": top_k,
    }
    headings = {f"headings_deg[{index}]": one for index, one in enumerate(headings_deg or ())}
    measured = {
        f"motions[{index}]['{name}']": value
        for index, one in enumerate(motions or ())
        for name, value in (one or {}).items()
    }
    _check_finite(given | headings | measured)
    told = {
        "motions": None if motions is None else [None if one is None else dict(one) for one in motions],
        "headings_deg": None if headings_deg is None else list(headings_deg),
    }
    known = {name: None if one is None else json.dumps(one) for name, one in told.items()}
    return _query("/localise/sequence", given | known, panoramas)


def _query(
    path: str, given: Mapping[str, object], panoramas: Sequence[bytes | str | os.PathLike[str] | Image]
) -> Request:
    """A form with pictures."""
    fields = {name: str(value) for name, value in given.items() if value is not None}
    media, content = _form("panorama", [_picture(panorama) for panorama in panoramas], fields)
    return Request("POST", path, headers={"Content-Type": media}, content=content)


def drawn_request(
    floorplan_id: str,
    panorama: bytes | str | os.PathLike[str] | Image,
    picture: Picture,
    picture_format: PictureFormat,
    **asked: Unpack[QueryOptions],
) -> Request:
    """A query whose answer is wanted as a picture.

    Raises:
        ValueError: no such format.
    """
    if picture_format not in _PICTURE_MEDIA:
        raise ValueError(f"picture_format is {picture_format!r}, it must be one of {', '.join(_PICTURE_MEDIA)}")
    query = localise_request(floorplan_id, panorama, **asked)
    headers = {**query.headers, "Accept": _PICTURE_MEDIA[picture_format]}
    return replace(query, params={"picture": picture}, headers=headers)


def limits_request() -> Request:
    """What the service allows."""
    return Request("GET", "/limits")


def ready_request() -> Request:
    """Whether the service can answer; 503 says that it cannot yet."""
    return Request("GET", "/readyz", answers=frozenset({200, 503}))


def _check_finite(given: Mapping[str, object]) -> None:
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} is {value}, it must be a finite number")


def _plan_path(floorplan_id: str) -> str:
    return resource_path("floorplans", "floorplan_id", floorplan_id)


def resource_path(collection: str, name: str, given: str) -> str:
    """Where something with an id is.

    Raises:
        ValueError: what was given as `name` is no id.
    """
    # Anything else could name another route, however it is quoted: servers undo that before they look.
    if not _ID.fullmatch(given):
        raise ValueError(f"{name} is {given!r:.100}, it must be 1 to 128 letters, digits, _ or -")
    return f"/{collection}/{given}"


def _plan_body(document: Document, options: Mapping[str, object] | None) -> tuple[str, bytes]:
    """Media type and content: the file alone, whose format the service finds out, or a form with what is said of it."""
    content = _document(document)
    if not options:
        return _JSON if isinstance(document, Mapping) else _FILE, content
    _check_finite(options)
    return _form("file", [content], {name: str(value) for name, value in options.items() if value is not None})


def _form(name: str, contents: Sequence[bytes], fields: Mapping[str, str]) -> tuple[str, bytes]:
    """Media type and content of a form with files, all of one name."""
    # Made of the content, so that the same request is the same bytes.
    boundary = hashlib.sha256(b"".join(contents)).hexdigest()
    encoded = httpx.Request(
        "POST",
        "http://service/",
        headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
        data=dict(fields),
        files=[(name, (name, content, _FILE)) for content in contents],
    )
    return encoded.headers["content-type"], encoded.read()


def _document(document: Document) -> bytes:
    if isinstance(document, bytes):
        return document
    if isinstance(document, Mapping):
        return json.dumps(dict(document), allow_nan=False).encode()
    return Path(document).read_bytes()


def _picture(panorama: bytes | str | os.PathLike[str] | Image) -> bytes:
    if isinstance(panorama, bytes):
        return panorama
    if isinstance(panorama, str | os.PathLike):
        return Path(panorama).read_bytes()
    buffer = io.BytesIO()
    panorama.convert("RGB").save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()
