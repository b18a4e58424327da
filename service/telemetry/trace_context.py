"""W3C Trace Context: the `traceparent` header, which connects the spans of services.

Source: W3C Recommendation "Trace Context", sections 3.2 (the header) and 4 (processing model).
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

_SAMPLED = 0x01
_FORBIDDEN_VERSION = "ff"
_PARENT = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")


@dataclass(frozen=True)
class TraceContext:
    """Span of a trace: lower-case hexadecimal ids, and the caller's sampling flag."""

    trace_id: str
    span_id: str
    sampled: bool

    @property
    def header(self) -> str:
        """Value of `traceparent`; unknown flags are cleared, as the recommendation requires."""
        return f"00-{self.trace_id}-{self.span_id}-{_SAMPLED if self.sampled else 0:02x}"


def parse_traceparent(values: Sequence[str]) -> TraceContext | None:
    """Return the caller's span; None if the header is missing, repeated or invalid.

    In versions above 00, the known fields are read if a dash follows them.
    """
    match = _PARENT.fullmatch(values[0].strip(" \t")) if len(values) == 1 else None
    if match is None:
        return None
    version, trace_id, span_id, flags, more = match.groups()
    if version == _FORBIDDEN_VERSION or (version == "00" and more is not None):
        return None
    # All zeros is invalid.
    if not int(trace_id, 16) or not int(span_id, 16):
        return None
    return TraceContext(trace_id, span_id, bool(int(flags, 16) & _SAMPLED))


def child_of(parent: TraceContext | None) -> TraceContext:
    """Return a new span in the caller's trace, or in a new, unsampled trace."""
    span_id = secrets.token_hex(8)
    if parent is None:
        return TraceContext(secrets.token_hex(16), span_id, sampled=False)
    return TraceContext(parent.trace_id, span_id, parent.sampled)
