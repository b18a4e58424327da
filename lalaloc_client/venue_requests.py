"""What is sent about venues."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from lalaloc_client.model import VenueAnchor, VenuePlan
from lalaloc_client.requests import Request, resource_path
from lalaloc_client.retry import Safety

_JSON = "application/json"
# For what is to stay as it is, where None has a meaning.
Unchanged = Literal["unchanged"]


def make_request(
    plans: Iterable[VenuePlan], name: str | None, anchor: VenueAnchor | None, idempotency_key: str | None
) -> Request:
    """Make a venue; the key lets the service see that a second one is the same request."""
    headers = {"Content-Type": _JSON, "Idempotency-Key": idempotency_key or uuid.uuid4().hex}
    return Request("POST", "/venues", headers=headers, content=_document(plans, name, anchor))


def replace_request(
    venue_id: str,
    plans: Iterable[VenuePlan],
    name: str | None,
    anchor: VenueAnchor | None,
    if_match: str | None,
) -> Request:
    """Replace a venue."""
    return _write("PUT", venue_id, _document(plans, name, anchor), if_match)


def change_request(
    venue_id: str,
    *,
    name: str | None,
    anchor: VenueAnchor | Unchanged | None,
    plans: Iterable[VenuePlan],
    remove: Sequence[str],
    if_match: str | None,
) -> Request:
    """Change a venue; a second one may be refused, as plans can be taken out once."""
    change: dict[str, Any] = {} if name is None else {"name": name}
    if anchor != "unchanged":
        change["anchor"] = None if anchor is None else anchor.to_dict()
    if put_in := [plan.to_dict() for plan in plans]:
        change["plans"] = put_in
    if remove:
        change["remove"] = [remove] if isinstance(remove, str) else list(remove)
    request = _write("PATCH", venue_id, _encoded(change), if_match)
    return Request("PATCH", request.path, headers=request.headers, content=request.content, safety=Safety.UNSENT)


def venue_request(venue_id: str) -> Request:
    """Look at a venue."""
    return Request("GET", _path(venue_id))


def plans_request(venue_id: str, level: float | None, limit: int, cursor: str | None) -> Request:
    """One page of the plans of a venue."""
    given = {"level": None if level is None else str(level), "limit": str(limit), "cursor": cursor}
    params = {key: value for key, value in given.items() if value is not None}
    return Request("GET", f"{_path(venue_id)}/plans", params)


def page_request(name: str | None, limit: int, cursor: str | None) -> Request:
    """One page of the stored venues."""
    given = {"name": name, "limit": str(limit), "cursor": cursor}
    return Request("GET", "/venues", {key: value for key, value in given.items() if value is not None})


def delete_request(venue_id: str) -> Request:
    """Delete a venue."""
    return Request("DELETE", _path(venue_id))


def _write(method: str, venue_id: str, content: bytes, if_match: str | None) -> Request:
    headers = {"Content-Type": _JSON} | ({} if if_match is None else {"If-Match": if_match})
    safety = Safety.ANY if if_match is None else Safety.UNSENT
    return Request(method, _path(venue_id), headers=headers, content=content, safety=safety)


def _document(plans: Iterable[VenuePlan], name: str | None, anchor: VenueAnchor | None) -> bytes:
    document: dict[str, Any] = {"plans": [plan.to_dict() for plan in plans]}
    if name is not None:
        document["name"] = name
    if anchor is not None:
        document["anchor"] = anchor.to_dict()
    return _encoded(document)


def _encoded(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, allow_nan=False).encode()


def _path(venue_id: str) -> str:
    return resource_path("venues", "venue_id", venue_id)
