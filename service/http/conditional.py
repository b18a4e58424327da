"""Conditional requests of RFC 9110: entity tags, and answers and refusals that depend on them.

Every tag is a strong one: the same tag means the same bytes. That of a plan's representation is
`"<revision id>.<digest of the bytes>"`, as status and progress change while the revision stays. Whoever replaces or
deletes a plan cares about the revision and not about progress, so `If-Match` is compared with the part before the dot:
it holds for every tag that the current revision ever had, and for the plain `"<revision id>"`. Venues have tags of the
same kind.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass

from starlette.requests import Request
from starlette.responses import Response

from service.errors import InvalidRequestError, RevisionMismatchError

# Kept by the caller alone, and asked about each time: keys may be revoked, and plans be replaced.
_CACHED = {"Cache-Control": "private, no-cache"}
_TAG = re.compile(r'[ \t,]*(W/)?"([\x21\x23-\x7e\x80-\xff]*)"[ \t]*(?:,[ \t,]*|\Z)')
_DIGITS = 32


@dataclass(frozen=True)
class Tags:
    """A list of entity tags; `any` stands for `*`.

    Attributes:
        strong: the tags without their quotes, but for those that are weak.
        all: weak ones included.
    """

    any: bool
    strong: frozenset[str]
    all: frozenset[str]


def content_etag(content: bytes) -> str:
    """The tag of a representation that is nothing but its bytes."""
    return f'"{hashlib.sha256(content).hexdigest()[:_DIGITS]}"'


def plan_etag(revision_id: str, content: bytes) -> str:
    """The tag of a plan's representation at one of its revisions."""
    return f'"{revision_id}.{hashlib.sha256(content).hexdigest()[:_DIGITS]}"'


def conditional_answer(
    request: Request, content: bytes, media_type: str, etag: str, headers: Mapping[str, str] | None = None
) -> Response:
    """What a GET is answered with: the representation, or 304 when the caller has it.

    Raises:
        InvalidRequestError: an If-None-Match that is no list of entity tags.
    """
    known = _tags(request, "If-None-Match")
    common = {"ETag": etag, **_CACHED, **(headers or {})}
    if known is not None and (known.any or etag.strip('"') in known.all):
        return Response(status_code=304, headers=common)
    return Response(content, media_type=media_type, headers=common)


def expected_revision(request: Request, of_id: str, revision_id: str, *, what: str = "floor plan") -> str | None:
    """Whether a request may change a plan, or a venue, at its current revision.

    Returns:
        the revision that it must still have when it is changed, None when any is well.

    Raises:
        RevisionMismatchError: `If-Match` names other revisions only, or `If-None-Match` names this one.
        InvalidRequestError: a header that is no list of entity tags.
    """
    wanted, unwanted = _tags(request, "If-Match"), _tags(request, "If-None-Match")
    if unwanted is not None and (unwanted.any or revision_id in _revisions(unwanted.all)):
        raise RevisionMismatchError(of_id, "any other (If-None-Match)", revision_id, what=what)
    if wanted is None or wanted.any:
        return None
    named = _revisions(wanted.strong)
    if revision_id not in named:
        raise RevisionMismatchError(of_id, ", ".join(sorted(named)) or "a weak tag", revision_id, what=what)
    return revision_id


def _revisions(tags: frozenset[str]) -> set[str]:
    return {tag.partition(".")[0] for tag in tags}


def _tags(request: Request, name: str) -> Tags | None:
    """The tags in a header, which may come in several lines; None when there is none."""
    values = request.headers.getlist(name)
    if not values:
        return None
    text = ", ".join(values).strip(" \t")
    if text == "*":
        return Tags(any=True, strong=frozenset(), all=frozenset())
    found: list[tuple[bool, str]] = []
    end = 0
    while end < len(text) and (tag := _TAG.match(text, end)) is not None:
        found.append((tag[1] is not None, tag[2]))
        end = tag.end()
    if not found or end < len(text):
        raise InvalidRequestError([(name, f"is '{text[:100]}', not * and no list of entity tags in double quotes")])
    strong = frozenset(opaque for weak, opaque in found if not weak)
    return Tags(any=False, strong=strong, all=frozenset(opaque for _, opaque in found))
