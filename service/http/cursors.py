"""Cursors: positions in a list as opaque text, with one text per position."""

from __future__ import annotations

import base64
import math
import re
import struct
from datetime import UTC, datetime, timedelta

from service.errors import InvalidRequestError
from service.storage.records import Cursor, VenuePlace

# Microseconds since 1970 and the 16 bytes of an id: 24 bytes are 32 characters without padding.
_LAYOUT = struct.Struct(">Q16s")
# A level, and the 16 bytes of an id.
_VENUE_LAYOUT = struct.Struct(">d16s")
_TEXT = re.compile(r"[A-Za-z0-9_-]{32}")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_LAST = (datetime.max.replace(tzinfo=UTC) - _EPOCH) // _MICROSECOND


def cursor_text(cursor: Cursor) -> str:
    """Return the cursor of a position in a list of plans or venues."""
    moment = (cursor.created_at - _EPOCH) // _MICROSECOND
    return base64.urlsafe_b64encode(_LAYOUT.pack(moment, bytes.fromhex(cursor.id))).decode("ascii")


def parse_cursor(text: str) -> Cursor:
    """Return the position of a cursor.

    Raises:
        InvalidRequestError: not a cursor of `cursor_text`.
    """
    if _TEXT.fullmatch(text):
        moment, plan_id = _LAYOUT.unpack(base64.urlsafe_b64decode(text))
        if moment <= _LAST:
            return Cursor(_EPOCH + moment * _MICROSECOND, plan_id.hex())
    raise _no_cursor(text)


def venue_cursor_text(place: VenuePlace) -> str:
    """Return the cursor of a position in the plans of a venue."""
    return base64.urlsafe_b64encode(_VENUE_LAYOUT.pack(place.level, bytes.fromhex(place.plan_id))).decode("ascii")


def parse_venue_cursor(text: str) -> VenuePlace:
    """Return the position of a cursor in the plans of a venue.

    Raises:
        InvalidRequestError: not a cursor of `venue_cursor_text`.
    """
    if _TEXT.fullmatch(text):
        level, plan_id = _VENUE_LAYOUT.unpack(base64.urlsafe_b64decode(text))
        if math.isfinite(level):
            return VenuePlace(level, plan_id.hex())
    raise _no_cursor(text)


def _no_cursor(text: str) -> InvalidRequestError:
    return InvalidRequestError([("cursor", f"is '{text[:100]}'; give the next_cursor of a list")])
