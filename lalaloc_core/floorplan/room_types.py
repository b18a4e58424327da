"""Types of rooms by their fixtures and names.

`plan_words.toml` has the names in twelve languages, and the other words of plans.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from lalaloc_core.conventions import ROOM_TYPES

# Words of plans by table and key.
PLAN_WORDS: Mapping[str, Mapping[str, str]] = tomllib.loads(
    Path(__file__).with_name("plan_words.toml").read_text(encoding="utf-8")
)


def keys_by_word(table: str) -> dict[str, str]:
    """Return the key of every word in a table of `PLAN_WORDS`; of several the first, and in the order of the keys."""
    found: dict[str, str] = {}
    for key, words in PLAN_WORDS[table].items():
        found |= {word: key for word in words.split() if word not in found}
    return found


_TYPE_OF = keys_by_word("rooms")
# Words that tell a room's type.
ROOM_WORDS = tuple(_TYPE_OF)
# Rooms without walls between them; names can list these without a separator ("Living dining").
_OPEN_PLAN = ("living", "dining", "kitchen")
_COMPOUNDS = {word: tuple(kinds.split()) for word, kinds in keys_by_word("open_plan").items()}
# German compounds: "Wohnküche", "Wohn-/Essbereich", "Wohnschlafzimmer".
_USES = {"wohn": "living", "ess": "dining", "koch": "kitchen", "schlaf": "bedroom"}
_GERMAN = re.compile(rf"((?:{'|'.join(_USES)})+)(zimmer|bereich|raum|ecke|nische|diele|teil|kuche|kueche)?")
# Names of several uses: "Bath / laundry", "Bedroom and office".
_SEPARATORS = re.compile(r"[/&+,;|\n]|\s(?:and|und|en|och|og|with|mit|avec|con|com|med|e|y|et|z|i)\s", re.IGNORECASE)
_LONGEST_PHRASE = 4
# Shorter words have no plurals but those with s.
_SHORTEST_PLURAL = 5
_JAPANESE = keys_by_word("rooms_in_japanese")
# Room types by the fixtures that only rooms of this type have.
_TYPE_OF_FIXTURE: Mapping[str, str] = {"toilet": "bathroom", "shower": "bathroom", "bath": "bathroom",
                                       "stove": "kitchen", "bed": "bedroom"}  # fmt: skip
# Larger rooms (m²) have fixtures of several uses, and stairs fill at least this share of a stairwell.
_MAX_TYPED_M2: Mapping[str, float] = {"bathroom": 40.0, "kitchen": 40.0, "bedroom": 60.0}
_STAIRWELL = 0.3
# Letters that have no base letter with an accent.
_LETTERS = str.maketrans({"ß": "ss", "ø": "o", "Ø": "O", "æ": "ae", "Æ": "AE", "ł": "l", "Ł": "L", "đ": "d", "œ": "oe"})


def split_words(text: str) -> list[str]:
    """Split a name such as "A-DOOR_Frame", "LivingRoom" or "Außentür" into lower-case words without accents."""
    spaced = re.sub(r"(?<=[a-zß-öø-ÿł])(?=[A-ZÀ-ÞŁ])", " ", text)
    folded = unicodedata.normalize("NFKD", spaced.translate(_LETTERS)).encode("ascii", "ignore").decode().casefold()
    return re.findall(r"[a-z]+", folded)


@lru_cache(maxsize=4096)
def room_types_from_name(name: str | None) -> tuple[str, ...]:
    """Return the types of a room by its name, without numbers and plurals, in the order in which it names them.

    Most rooms have one type or, without a known word, none. Names that list several uses have several: "Living /
    dining", "Wohnküche", "K/F". Of other names the first known word decides: "Bedroom closet" is a bedroom.
    """
    if not name:
        return ()
    found = _types_of_words(split_words(name))
    for part in () if found else _SEPARATORS.split(name):
        kinds = list(_kinds_in_order(split_words(part)))
        found += tuple(kinds if set(kinds) <= set(_OPEN_PLAN) else kinds[:1])
    if not found:
        text = unicodedata.normalize("NFKC", name)
        words = [word for word in _JAPANESE if word in text]
        if not {_JAPANESE[word] for word in words} <= set(_OPEN_PLAN):
            words = words[:1]
        found = tuple(_JAPANESE[word] for word in sorted(words, key=text.index))
    return tuple(dict.fromkeys(found))


def room_type_from_label(label: str) -> str:
    """Return the first of `room_types_from_name`; "unknown" if no word is known."""
    return next(iter(room_types_from_name(label)), ROOM_TYPES[0])


def type_fields(types: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a plan's document with the types of a room."""
    fields: dict[str, Any] = {"type": types[0]} if types else {}
    return fields | ({"types": list(types)} if len(types) > 1 else {})


def types_by_fixtures(types: Sequence[str], fixtures: Collection[tuple[str, float]], area_m2: float) -> tuple[str, ...]:
    """Return the types of a room with those that its fixtures add; `fixtures` are kinds and areas (m²)."""
    kinds = {kind for kind, _ in fixtures}
    found = {_TYPE_OF_FIXTURE[kind] for kind in kinds if kind in _TYPE_OF_FIXTURE}
    found |= {"kitchen"} if {"sink", "fridge"} <= kinds else set()
    if not types:
        found = {kind for kind in found if area_m2 <= _MAX_TYPED_M2[kind]}
        if not found and kinds == {"sofa"}:
            return ("living",)
        stairs_m2 = sum(size_m2 for kind, size_m2 in fixtures if kind == "stairs")
        if not found and stairs_m2 > 0.0 and stairs_m2 >= _STAIRWELL * area_m2:
            return ("stairs",)
    return (*types, *sorted(found.difference(types)))


def _kinds_in_order(words: list[str]) -> Iterator[str]:
    """Yield the types of the longest known phrases of a name."""
    first = 0
    while first < len(words):
        for last in range(min(first + _LONGEST_PHRASE, len(words)), first, -1):
            kinds = _types_of_words(words[first:last])
            if kinds:
                yield from kinds
                break
        else:
            last = first + 1
        first = last


def _types_of_words(words: Sequence[str]) -> tuple[str, ...]:
    """Return the types of a word or phrase; empty for others."""
    # Compare whole words only: the Finnish "et" must not match "sheet".
    phrase, singular = "".join(words), "".join(word.removesuffix("s") for word in words)
    for form in (phrase, singular, *_singulars(phrase)):
        if form in _COMPOUNDS:
            return _COMPOUNDS[form]
        if form in _TYPE_OF:
            return (_TYPE_OF[form],)
        if german := _GERMAN.fullmatch(form):
            uses = tuple(_USES[use] for use in re.findall("|".join(_USES), german[1]))
            return (*uses, "kitchen") if (german[2] or "").startswith("ku") else uses
    return ()


def _singulars(word: str) -> Iterator[str]:
    """Yield what a plural can come from: "Offices", "Lobbies", "Küchen", "Toiletter", "Camere", "Sypialnie"."""
    yield f"{word[:-3]}y" if word.endswith("ies") else word.removesuffix("s")
    yield word.removesuffix("es")
    if len(word) > _SHORTEST_PLURAL:
        yield from (word.removesuffix(ending) for ending in ("en", "er", "n", "r") if word.endswith(ending))
        if word[-1] in "eiy":
            yield f"{word[:-1]}a"
