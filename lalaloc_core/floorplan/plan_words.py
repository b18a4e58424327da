"""Words of plans (`plan_words.toml`): roles of layers, blocks and classes, roofs, fixtures, misread names of rooms."""

from __future__ import annotations

import re
import unicodedata
from difflib import get_close_matches
from functools import lru_cache
from itertools import pairwise
from typing import Literal, cast

from lalaloc_core.floorplan.room_types import PLAN_WORDS, ROOM_WORDS, keys_by_word, room_types_from_name, split_words

Role = Literal["demolished", "door", "window", "passage", "obstacle", "wall", "room", "text", "ignored"]

# Words that can be misread: the shortest, and the least share of letters that are right (`difflib`'s ratio).
_SHORTEST_READING, _MIN_ALIKE = 5, 0.84
_ROLE_OF = cast("dict[str, Role]", keys_by_word("roles"))
# The first match wins: "A-WALL-DOOR" is a door layer, "window dimensions" is ignored.
_ORDER = cast("list[Role]", list(PLAN_WORDS["roles"]))
_ENDINGS = cast("dict[str, Role]", keys_by_word("role_endings"))
_OTHER_SCRIPTS = cast("dict[str, Role]", keys_by_word("roles_in_other_scripts"))
# Layers of the US National CAD Standard with the status "demolish".
_DEMOLISHED = re.compile(r"[A-Z]{1,2}-[A-Z]{4}(?:-[A-Z]{4})*-D", re.IGNORECASE)
# Words for roofs, and those that stand beside them in names of levels.
_ROOFS, _OF_LEVELS = (frozenset(PLAN_WORDS["levels"][key].split()) for key in ("roof", "beside"))
_KIND_OF, _IN_JAPANESE = keys_by_word("fixtures"), keys_by_word("fixtures_in_japanese")
# Order in which kinds are looked for: a "kitchen sink with stove" is a stove.
_KINDS = list(PLAN_WORDS["fixtures"])


def is_roof(level: str) -> bool:
    """Return whether a level is a roof by its name: "Roof", "Roof level", "04 - Dach", but no "Roof terrace"."""
    words = [word for word in split_words(level) if word not in _OF_LEVELS]
    return bool(words) and all(word in _ROOFS for word in words)


def mentions_roof(level: str) -> bool:
    """Return whether a level is at a roof by its name, such as "Roof terrace"."""
    return any(word in _ROOFS for word in split_words(level))


def role_from_name(text: str) -> Role | None:
    """Return the role of a layer, block or class from its name, None if the name gives none."""
    if _DEMOLISHED.fullmatch(text):
        return "demolished"
    found = {role for word in split_words(text) if (role := _role_of_word(word)) is not None}
    composed = unicodedata.normalize("NFKC", text)
    found |= {role for word, role in _OTHER_SCRIPTS.items() if word in composed}
    return next((role for role in _ORDER if role in found), None)


@lru_cache(maxsize=1024)
def room_types_from_reading(text: str | None) -> tuple[str, ...]:
    """Return the room types of a text in a picture, misread or without its spaces ("lving", "openporch")."""
    found = room_types_from_name(text)
    if found or not text:
        return found
    words = [word for word in split_words(text) if len(word) >= _SHORTEST_READING]
    long = [known for known in ROOM_WORDS if len(known) >= _SHORTEST_READING]
    likely = ([*filter(word.endswith, long)] or get_close_matches(word, ROOM_WORDS, 1, _MIN_ALIKE) for word in words)
    return next((room_types_from_name(word) for found_words in likely for word in found_words), ())


def _role_of_word(word: str) -> Role | None:
    if word in _ROLE_OF:
        return _ROLE_OF[word]
    return next((role for ending, role in _ENDINGS.items() if word.endswith(ending) and len(word) > len(ending)), None)


def fixture_from_name(*names: str | None) -> str | None:
    """Return the kind of a fixture from the names of its block, class or type; the first that gives one decides."""
    for name in names:
        words = split_words(name or "")
        pairs = [first + second for first, second in pairwise(words)]
        found = {_KIND_OF[word] for word in (*words, *pairs) if word in _KIND_OF}
        if found:
            return min(found, key=_KINDS.index)
        text = unicodedata.normalize("NFKC", name or "")
        if kinds := [kind for word, kind in _IN_JAPANESE.items() if word in text]:
            return kinds[0]
    return None
