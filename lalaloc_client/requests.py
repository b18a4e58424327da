"""Requests as plain data: repeating one sends the same bytes."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import httpx

from lalaloc_client.model import ImportStep
from lalaloc_client.options import FilmOptions, Options, QueryOptions, SequenceOptions, ViewOptions
from lalaloc_client.retry import Safety

if TYPE_CHECKING:
    from PIL.Image import Image

Document = Mapping[str, Any] | bytes | str | os.PathLike[str]
Photograph: TypeAlias = "bytes | str | os.PathLike[str] | Image"
Picture = Literal["both", "plan", "photograph"]
PictureFormat = Literal["png", "svg"]
Covariance = tuple[tuple[float, float], tuple[float, float]]

PICTURE_MEDIA: Mapping[PictureFormat, str] = {"png": "image/png", "svg": "image/svg+xml"}
JSON, NDJSON = "application/json", "application/x-ndjson"
_FILE, _PHOTO = "application/octet-stream", "photo"
_JPEG_QUALITY = 95
# First bytes of a file of features.
_FEATURES = b"LLFT"
_ID = re.compile(r"[A-Za-z0-9_-]{1,128}")


@dataclass(frozen=True)
class Request:
    """One request to the service.

    Attributes:
        params: query parameters; a list is sent as one parameter per item.
        streamed: read the answer as it arrives, for as long as it takes.
        on_step: called with every step of the import that the request asks for; needs `Accept: application/x-ndjson`.
    """

    method: str
    path: str
    params: Mapping[str, str | list[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes = b""
    safety: Safety = Safety.ANY
    answers: frozenset[int] = frozenset({200, 201, 204})
    streamed: bool = False
    on_step: Callable[[ImportStep], None] | None = None


def http_options(base_url: str, api_key: str | None, timeout_s: float) -> dict[str, Any]:
    """Return the options of an httpx client."""
    address = httpx.URL(base_url)
    if address.scheme not in ("http", "https") or not address.host:
        raise ValueError(f"base_url is '{base_url}'; it must begin with http:// or https:// and name a host")
    if not timeout_s > 0.0:
        raise ValueError(f"timeout_s is {timeout_s}; it must be greater than 0")
    headers = {"Accept": JSON, "User-Agent": "lalaloc-client"}
    if api_key is not None:
        if not (api_key.isascii() and api_key.isprintable()) or not api_key or " " in api_key:
            # The message leaves the value out: a mistyped key is still mostly the secret.
            raise ValueError("api_key must be printable ASCII without spaces, and not empty")
        headers["Authorization"] = f"Bearer {api_key}"
    return {"base_url": address, "headers": headers, "timeout": timeout_s}


Collection = Literal["floorplans", "venues", "answers", "sessions", "albums", "photographs"]


def resource_path(collection: Collection, resource_id: str) -> str:
    """Return the path of a resource."""
    # Quoting does not keep other characters from naming another route: servers unquote before they route.
    if not _ID.fullmatch(resource_id):
        raise ValueError(f"{collection[:-1]}_id is {resource_id!r:.100}; it must be 1 to 128 letters, digits, _ or -")
    return f"/{collection}/{resource_id}"


def text_values(values: Mapping[str, object]) -> dict[str, Any]:
    """Return values as texts, lists and mappings as JSON; leave out None."""
    for name, value in values.items():
        _check_finite(name, value)
    return {name: _text(value) for name, value in values.items() if value is not None}


def json_request(
    method: str,
    path: str,
    document: Mapping[str, Any],
    *,
    if_match: str | None = None,
    idempotency_key: str | None = None,
    safety: Safety = Safety.ANY,
) -> Request:
    """Return a request with a JSON body."""
    headers = {"Content-Type": JSON, **_headers(if_match, idempotency_key)}
    content = json.dumps(document, allow_nan=False).encode()
    return Request(method, path, headers=headers, content=content, safety=_safety(if_match, safety))


def plan_request(
    method: str,
    path: str,
    document: Document,
    options: Mapping[str, object] | None,
    *,
    if_match: str | None = None,
    idempotency_key: str | None = None,
    on_step: Callable[[ImportStep], None] | None = None,
) -> Request:
    """Return a request that stores a plan: as a form with the file's name and the options, or as the document alone.

    With `on_step` the service is asked for the steps of the import.
    """
    if isinstance(document, bytes):
        content = document
    elif isinstance(document, Mapping):
        content = json.dumps(dict(document), allow_nan=False).encode()
    else:
        content = Path(document).read_bytes()
    is_file = isinstance(document, str | os.PathLike)
    if options or is_file:
        # The service names plans and venues without a name after it.
        default = "venue" if path.startswith("/venues") else "floor plan"
        name = os.path.basename(document) if is_file else default
        media, content = _form("file", [(name, content)], options or {})
    else:
        media = JSON if isinstance(document, Mapping) else _FILE
    headers = {"Content-Type": media, **_headers(if_match, idempotency_key)}
    if on_step is not None:
        headers["Accept"] = f"{NDJSON}, {JSON};q=0.5"
    return Request(method, path, headers=headers, content=content, safety=_safety(if_match), on_step=on_step)


def query_request(
    path: str,
    photographs: Sequence[Photograph],
    values: Mapping[str, object],
    options: Options | None = None,
    *,
    params: Mapping[str, str] | None = None,
    accept: str = JSON,
    streamed: bool = False,
) -> Request:
    """Return a query; repeating it is safe, as it stores nothing. Streamed queries state the names of the files."""
    known = dict(options or {})
    _check_known(known, SequenceOptions if path.endswith("/sequence") else QueryOptions)
    if isinstance(rooms := known.get("rooms"), str):
        known["rooms"] = [rooms]
    contents = [picture_file(photograph) for photograph in photographs]
    kinds = {"features" if content.startswith(_FEATURES) else _PHOTO for content in contents}
    if len(kinds) > 1:
        raise ValueError("photographs and features cannot be in one query; send either")
    kind = "".join(kinds) or _PHOTO
    names = [_name(photograph) if streamed else kind for photograph in photographs]
    media, content = _form(kind, list(zip(names, contents, strict=True)), {**values, **known})
    return Request("POST", path, params or {}, {"Content-Type": media, "Accept": accept}, content, streamed=streamed)


def film_request(
    path: str, film: bytes | str | os.PathLike[str], values: Mapping[str, object], options: FilmOptions | ViewOptions
) -> Request:
    """Return a query about a film."""
    _check_known(options, FilmOptions)
    content = film if isinstance(film, bytes) else Path(film).read_bytes()
    media, body = _form("film", [("film", content)], {**values, **options})
    return Request("POST", path, headers={"Content-Type": media, "Accept": JSON}, content=body)


def preview_params(
    x_m: float | None, y_m: float | None, heading_deg: float | None, covariance_m2: Covariance | None
) -> dict[str, Any]:
    """Return the parameters of a plan's drawing."""
    if (x_m is None) != (y_m is None):
        raise ValueError(f"x_m is {x_m} and y_m is {y_m}; give both or neither")
    if x_m is None and not (heading_deg is None and covariance_m2 is None):
        raise ValueError("heading_deg and covariance_m2 need a position; give x_m and y_m as well")
    _check_finite("covariance_m2", covariance_m2)
    params: dict[str, Any] = text_values({"x_m": x_m, "y_m": y_m, "heading_deg": heading_deg})
    if covariance_m2 is not None:
        (xx, xy), (_, yy) = covariance_m2
        params["covariance_m2"] = [str(xx), str(xy), str(yy)]
    return params


def _check_known(options: Mapping[str, object], kind: Any) -> None:
    if unknown := options.keys() - kind.__optional_keys__:
        raise TypeError(f"unknown options: {', '.join(sorted(unknown))}; see {kind.__name__}")


def _headers(if_match: str | None, idempotency_key: str | None) -> dict[str, str]:
    headers = {"If-Match": if_match, "Idempotency-Key": idempotency_key}
    return {name: value for name, value in headers.items() if value is not None}


def _safety(if_match: str | None, safety: Safety = Safety.ANY) -> Safety:
    # The service refuses a repeated conditional request even if the first one succeeded.
    return safety if if_match is None else Safety.UNSENT


def _form(name: str, files: Sequence[tuple[str, bytes]], values: Mapping[str, object]) -> tuple[str, bytes]:
    """Return media type and content of a form with files, by name and content, all in the field `name`."""
    # Derived from the content, so that the same request has the same bytes.
    boundary = hashlib.sha256(b"".join(content for _, content in files)).hexdigest()
    encoded = httpx.Request(
        "POST",
        "http://service/",
        headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
        data=text_values(values),
        # Names of files can hold bytes that are no UTF-8.
        files=[(name, (text.encode(errors="replace").decode(), content, _FILE)) for text, content in files],
    )
    return encoded.headers["content-type"], encoded.read()


def _name(photograph: Photograph) -> str:
    return os.path.basename(photograph) if isinstance(photograph, str | os.PathLike) else _PHOTO


def picture_file(photograph: Photograph) -> bytes:
    """Return the content of a file, or a PIL image as JPEG."""
    if isinstance(photograph, bytes):
        return photograph
    if isinstance(photograph, str | os.PathLike):
        return Path(photograph).read_bytes()
    buffer = io.BytesIO()
    photograph.convert("RGB").save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


def _check_finite(name: str, value: object) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} is {value}; it must be a finite number")
    if isinstance(value, Mapping):
        for key, item in value.items():
            _check_finite(f"{name}[{key!r}]", item)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        for index, item in enumerate(value):
            _check_finite(f"{name}[{index}]", item)


def _text(value: object) -> str:
    if isinstance(value, Mapping) or (isinstance(value, Sequence) and not isinstance(value, str)):
        return json.dumps(value, default=lambda item: dict(item) if isinstance(item, Mapping) else list(item))
    return str(value)
