"""Cursors: positions in a list as opaque text, with one text per position."""

from __future__ import annotations

import base64
import math
import re
import struct
from datetime import UTC, datetime, timedelta
from typing import Any

from service.errors import InvalidRequestError
from service.storage.records import Cursor, VenuePlace

# Microseconds since 1970 or a level, then the 16 bytes of an id: 24 bytes are 32 characters without padding.
_MOMENT, _LEVEL = struct.Struct(">Q16s"), struct.Struct(">d16s")
_TEXT = re.compile(r"[A-Za-z0-9_-]{32}")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_LAST = (datetime.max.replace(tzinfo=UTC) - _EPOCH) // _MICROSECOND


def cursor_text(place: Cursor | VenuePlace) -> str:
    """Return the cursor of a position in a list, or in the plans of a venue."""
    if isinstance(place, VenuePlace):
        packed = _LEVEL.pack(place.level, bytes.fromhex(place.plan_id))
    else:
        packed = _MOMENT.pack((place.created_at - _EPOCH) // _MICROSECOND, bytes.fromhex(place.id))
    return base64.urlsafe_b64encode(packed).decode("ascii")


def parse_cursor(text: str) -> Cursor:
    """Return the position of a cursor in a list."""
    moment, own_id = _unpack(_MOMENT, text)
    if moment > _LAST:
        raise _no_cursor(text)
    return Cursor(_EPOCH + moment * _MICROSECOND, own_id.hex())


def parse_venue_cursor(text: str) -> VenuePlace:
    """Return the position of a cursor in the plans of a venue; raises as `parse_cursor` does."""
    level, plan_id = _unpack(_LEVEL, text)
    if not math.isfinite(level):
        raise _no_cursor(text)
    return VenuePlace(level, plan_id.hex())


def _unpack(layout: struct.Struct, text: str) -> tuple[Any, ...]:
    if not _TEXT.fullmatch(text):
        raise _no_cursor(text)
    return layout.unpack(base64.urlsafe_b64decode(text))


def _no_cursor(text: str) -> InvalidRequestError:
    return InvalidRequestError([("cursor", f"is '{text[:100]}'; give the next_cursor of a list")])
