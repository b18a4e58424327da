"""Content negotiation by `Accept` (RFC 9110, section 12.5.1)."""

from __future__ import annotations

from starlette.requests import Request


def preferred(request: Request, offered: tuple[str, ...]) -> str:
    """Return the offered media type that the request prefers; the first one if several tie or none is accepted."""
    accepted = ",".join(request.headers.getlist("accept"))
    ranges = [_range(part) for part in accepted.split(",") if part.strip()]
    if not ranges:
        return offered[0]
    return max(offered, key=lambda media: _quality(media, ranges))


def _range(text: str) -> tuple[str, float]:
    """Return a media range and its weight; other parameters are ignored."""
    media, *parameters = (part.strip().lower() for part in text.split(";"))
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                return media, min(max(float(value), 0.0), 1.0)
            except ValueError:
                return media, 0.0
    return media, 1.0


def _quality(media: str, ranges: list[tuple[str, float]]) -> float:
    """Return the weight of the most specific range that contains a media type."""
    kind = media.split("/")[0]
    for pattern in (media, f"{kind}/*", "*/*"):
        found = [weight for accepted, weight in ranges if accepted == pattern]
        if found:
            return max(found)
    return 0.0
