"""Fixtures in plan files: their kinds by names in many languages, and the room types that follow from them."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely

from lalaloc_core.importers.common.geometry import side_lengths
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import SketchedFixture, SketchedRoom
from lalaloc_core.importers.common.vocabulary import split_words

# Words of names and types, in the order in which they are looked for: a "kitchen sink with stove" is a stove.
_WORDS: Mapping[str, str] = {
    "toilet": (
        "toilet toilets wc wcseat cistern klo toilette toiletten toiletpan watercloset inodoro bidet urinal urinals "
        "pissoir toalett toalettstol muszla ubikacja vaso sanita klosett"
    ),
    "shower": (
        "shower showers dusche duschen duschtasse duschwanne douche receveur ducha doccia chuveiro dusch dusj brusebad "
        "prysznic brodzik"
    ),
    "bath": (
        "bath bathtub bathtubs tub badewanne wanne baignoire banera banheira vasca badekar badkar wanna ligbad jacuzzi"
    ),
    "basin": (
        "basin basins washbasin washbasins washhandbasin lavatory lavabo waschbecken waschtisch handwaschbecken vasque "
        "lavatorio wastafel handfat tvattstall handvask vask servant umywalka"
    ),
    "stove": (
        "stove stoves cooker cooktop hob oven herd kochfeld backofen cuisiniere fornello fornelli fogao fornuis "
        "kookplaat kochherd komfyr komfur kuchenka piekarnik gasstove"
    ),
    "sink": (
        "sink sinks kitchensink spule spuele spulbecken evier fregadero lavello spoelbak gootsteen diskho oppvaskkum "
        "zlew zlewozmywak"
    ),
    "fridge": (
        "fridge refrigerator kuhlschrank kuehlschrank refrigerateur frigo nevera frigorifico frigorifero geladeira "
        "koelkast kylskap kjoleskap koleskab lodowka freezer"
    ),
    "washer": (
        "washer washingmachine washerdryer waschmaschine lavelinge lavadora lavatrice wasmachine tvattmaskin "
        "vaskemaskin vaskemaskine pralka dryer"
    ),
    "bed": (
        "bed beds bett betten doppelbett einzelbett letto cama seng sang lozko queenbed kingbed doublebed singlebed "
        "bunkbed"
    ),
    "sofa": "sofa sofas couch canape divano soffa kanapa",
    "stairs": (
        "stair stairs staircase stairway stairflight treppe treppen escalier escaliers escalera trappa trappor trapp "
        "schody"
    ),
}  # fmt: skip
_KIND_OF = {word: kind for kind, words in reversed(_WORDS.items()) for word in words.split()}
_ORDER = list(_WORDS)
_JAPANESE: Mapping[str, str] = {
    "便器": "toilet", "トイレ": "toilet", "シャワー": "shower", "浴槽": "bath", "洗面": "basin", "コンロ": "stove",
    "シンク": "sink", "流し": "sink", "冷蔵庫": "fridge", "洗濯機": "washer",
    "ベッド": "bed", "ソファ": "sofa", "階段": "stairs",
}  # fmt: skip
# Longer side of a fixture (m); others are symbols of another kind, or whole rooms.
_SIDES_M: Mapping[str, tuple[float, float]] = {
    "toilet": (0.3, 1.2), "shower": (0.5, 2.2), "bath": (0.8, 2.6), "basin": (0.2, 2.0), "stove": (0.3, 1.6),
    "sink": (0.25, 2.2), "fridge": (0.4, 1.6), "washer": (0.4, 1.5), "bed": (1.1, 2.8), "sofa": (0.8, 5.0),
    "stairs": (0.6, 20.0),
}  # fmt: skip
# Room types by the fixtures that only rooms of this type have.
_TYPE_OF: Mapping[str, str] = {"toilet": "bathroom", "shower": "bathroom", "bath": "bathroom", "stove": "kitchen",
                               "bed": "bedroom"}  # fmt: skip
# Larger rooms (m²) have fixtures of several uses, and stairs fill at least this share of a stairwell.
_MAX_TYPED_M2: Mapping[str, float] = {"bathroom": 40.0, "kitchen": 40.0, "bedroom": 60.0}
_STAIRWELL = 0.3
_MAX_NAMED = 5


def fixture_from_name(*names: str | None) -> str | None:
    """Return the kind of a fixture from the names of its block, class or type; the first that gives one decides."""
    for name in names:
        words = split_words(name or "")
        pairs = [first + second for first, second in pairwise(words)]
        found = {_KIND_OF[word] for word in (*words, *pairs) if word in _KIND_OF}
        if found:
            return min(found, key=_ORDER.index)
        text = unicodedata.normalize("NFKC", name or "")
        for word, kind in _JAPANESE.items():
            if word in text:
                return kind
    return None


def place_fixtures(
    fixtures: Sequence[SketchedFixture], rooms: Sequence[SketchedRoom], builder: ReportBuilder
) -> list[tuple[int, SketchedFixture]]:
    """Return the fixtures of usual size whose middle lies in a room, each with the number of its room."""
    if not fixtures:
        return []
    tree = shapely.STRtree([room.shape for room in rooms])
    points = [fixture.shape.representative_point() for fixture in fixtures]
    number, room = tree.query(points, predicate="within")
    first = np.full(len(fixtures), -1)
    first[number[::-1]] = room[::-1]
    placed, unusual = [], []
    for index, fixture in zip(first.tolist(), fixtures, strict=True):
        low, high = _SIDES_M[fixture.kind]
        _, longer = side_lengths(fixture.shape)
        if not low <= longer <= high:
            unusual.append(f"a {fixture.kind} of {longer:.2f} m (usual: {low:g} to {high:g} m)")
        elif index >= 0:
            placed.append((index, fixture))
    outside = len(fixtures) - len(placed) - len(unusual)
    if outside:
        builder.notes.append(f"{outside} fixtures that lie in no room were left out")
    if unusual:
        builder.notes.append(
            f"{len(unusual)} fixtures of unusual size were left out: {', '.join(unusual[:_MAX_NAMED])}; check the scale"
        )
    return placed


def type_rooms(
    rooms: Sequence[SketchedRoom], placed: Sequence[tuple[int, SketchedFixture]], builder: ReportBuilder
) -> list[SketchedRoom]:
    """Return the rooms, those without a type with the type of their fixtures, unless these contradict each other."""
    by_room: dict[int, list[SketchedFixture]] = {}
    for index, fixture in placed:
        by_room.setdefault(index, []).append(fixture)
    typed, lines = list(rooms), []
    for index, fixtures in by_room.items():
        kind = None if rooms[index].type else _type_by_fixtures(rooms[index], fixtures)
        if kind is not None:
            typed[index] = replace(rooms[index], type=kind)
            named = ", ".join(sorted({fixture.kind for fixture in fixtures}))
            lines.append(f"'{rooms[index].name or f'room {index + 1}'}' {kind} ({named})")
    if lines:
        more = f" and {len(lines) - _MAX_NAMED} more" if len(lines) > _MAX_NAMED else ""
        builder.unsure.append(f"types of rooms by their fixtures: {', '.join(lines[:_MAX_NAMED])}{more}")
    return typed


def _type_by_fixtures(room: SketchedRoom, fixtures: Sequence[SketchedFixture]) -> str | None:
    kinds = {fixture.kind for fixture in fixtures}
    types = {_TYPE_OF[kind] for kind in kinds if kind in _TYPE_OF}
    if {"sink", "fridge"} <= kinds:
        types.add("kitchen")
    if len(types) == 1:
        (kind,) = types
        return kind if room.shape.area <= _MAX_TYPED_M2[kind] else None
    stairs_m2 = sum(fixture.shape.area for fixture in fixtures if fixture.kind == "stairs")
    if not types and stairs_m2 >= _STAIRWELL * room.shape.area:
        return "stairs"
    return "living" if not types and kinds == {"sofa"} else None
