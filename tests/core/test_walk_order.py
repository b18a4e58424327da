"""Order of an album's photographs: time zones, clocks that differ, and forms of times."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from lalaloc_core.localise.album.entry import COLOURS, AlbumPhotograph
from lalaloc_core.localise.album.walk_order import walk_order
from lalaloc_core.photograph.exif import Taken, read_taken, read_time
from lalaloc_core.photograph.picture_folders import pictures_in, turn_files

_TEN = datetime(2026, 5, 1, 10)
_CERTAIN, _WEAK = (40, math.nan), (3, math.nan)


def _album(*taken: tuple[str, datetime | None]) -> list[AlbumPhotograph]:
    # The order depends on the times and cameras alone.
    return [
        AlbumPhotograph(id=str(number), photograph=cast(Any, None), taken=Taken(at=at, model=model))
        for number, (model, at) in enumerate(taken)
    ]


def _minutes(*minutes: float, zone_h: int | None = None) -> list[datetime]:
    zone = None if zone_h is None else timezone(timedelta(hours=zone_h))
    return [(_TEN + timedelta(minutes=minute)).replace(tzinfo=zone) for minute in minutes]


def test_instants_of_different_zones_are_one_order() -> None:
    first, second = _minutes(120, 122, 124, zone_h=2), _minutes(1, 3, zone_h=0)
    found = walk_order(_album(*(("A", at) for at in first), *(("B", at) for at in second)), {})
    assert found.order.tolist() == [0, 3, 1, 4, 2]
    assert found.follows.tolist() == [False, True, True, True, True]
    assert found.warnings == ()
    # A photograph without a zone has that of its camera.
    at = [*_minutes(0, 2, zone_h=2), *_minutes(1)]
    assert walk_order(_album(*(("A", time) for time in at)), {}).order.tolist() == [0, 2, 1]


def test_clock_difference_is_found_by_common_places() -> None:
    own, other = _minutes(0, 2, 4, 6), _minutes(61, 63, 65, 67)
    album = _album(*(("A", at) for at in own), *(("B", at) for at in other))
    links = {(0, 4): _CERTAIN, (1, 5): _CERTAIN, (3, 7): _CERTAIN, (0, 7): _WEAK}
    found = walk_order(album, links)
    assert sorted(found.order[[0, 1]].tolist()) == [0, 4]
    assert found.follows[1:].all()
    assert found.warnings == (
        "the clock of B is 1:01:00 ahead of that of A, by photographs of the same places, which the order takes into "
        "account",
    )


@pytest.mark.parametrize(
    ("names", "cameras"), [(("IMG_1", "IMG_2"), 1), (("IMG_1", "DSC_2"), 2), (("IMG_5", "IMG_2"), 2), (("", ""), 1)]
)
def test_cameras_of_one_model_have_clocks_of_their_own(names: tuple[str, str], cameras: int) -> None:
    album = _album(*(("A", at) for at in _minutes(0, 2, 4, 61, 63, 65)))
    album = [replace(each, name=names[number // 3]) for number, each in enumerate(album)]
    found = walk_order(album, {(0, 3): _CERTAIN, (1, 4): _CERTAIN, (2, 5): _CERTAIN})
    assert found.order.tolist() == ([0, 3, 1, 4, 2, 5] if cameras == 2 else [*range(6)])
    assert len(found.warnings) == cameras - 1
    assert cameras == 1 or f"the clock of A (of '{names[1]}') is 1:01:00 ahead of that of A (of" in found.warnings[0]


def test_clocks_that_cannot_be_compared_order_each_camera() -> None:
    own, other = _minutes(4, 0, 2), _minutes(1, 5)
    found = walk_order(_album(*(("A", at) for at in own), *(("B", at) for at in other)), {(0, 3): _CERTAIN})
    assert found.order.tolist() == [1, 2, 0, 3, 4]
    assert found.follows.tolist() == [False, True, True, False, True]
    assert "the clocks of A, B could not all be compared" in found.warnings[0]


def test_local_clock_is_compared_with_cameras_that_state_zones() -> None:
    local, zoned = _minutes(121, 123, 125), _minutes(120, 122, 124, zone_h=2)
    album = _album(*(("A", at) for at in local), *(("B", at) for at in zoned))
    found = walk_order(album, {(0, 3): _CERTAIN, (1, 4): _CERTAIN, (2, 5): _CERTAIN})
    assert found.follows[1:].all()
    assert found.warnings == (
        "the clock of A is 2:01:00 ahead of universal time, by photographs of the same places, which the order takes "
        "into account",
    )


def test_two_clocks_are_compared_through_a_third() -> None:
    names = [name for name in "ABC" for _ in range(3)]
    at = [*_minutes(0, 2, 4), *_minutes(60, 62, 64), *_minutes(30, 32, 34)]
    links = {(k, k + 6): _CERTAIN for k in range(3)} | {(k + 3, k + 6): _CERTAIN for k in range(3)}
    found = walk_order(_album(*zip(names, at, strict=True)), links)
    assert found.follows[1:].all()
    assert len(found.warnings) == 2


def test_photographs_without_time_and_later_visits_follow_nothing() -> None:
    at: list[datetime | None] = [*_minutes(0, 1, 2, 600), None]
    found = walk_order(_album(*(("A", time) for time in at)), {})
    follows = dict(zip(found.order.tolist(), found.follows.tolist(), strict=True))
    assert follows == {0: False, 1: True, 2: True, 3: False, 4: False}
    assert found.warnings[0].startswith("1 of 5 photographs have no time")
    # A time that all have is not theirs.
    assert "3 of 3 photographs have no time" in walk_order(_album(*[("A", _TEN)] * 3), {}).warnings[0]


@pytest.mark.parametrize(
    ("names", "rooms", "order", "text"),
    [
        (["IMG_10.jpg", "IMG_9.jpg", "img 1.jpg", "IMG_8.jpg", "IMG_7.jpg"], "aabbb", [4, 3, 1, 0], "from 'IMG_7.jpg'"),
        (["1 (2).jpg", "1 (10).jpg", "1 (1).jpg", "1 (9).jpg"], "abab", [2, 0, 3, 1], "to '1 (10).jpg'"),
        (["4.jpg", "3.jpg", "2.jpg", "1.jpg", "5.jpg", "6.jpg"], "abbaab", [], "tell no order"),
        (["3f.jpg", "a7.jpg", "9c1.jpg", "d04.jpg"], "aabb", [], "no place in the order"),
        (["1.jpg", "1.jpg", "2.jpg", "3.jpg"], "aabb", [], "no place in the order"),
        (["1.jpg", "2.jpg", "3.jpg"], "aab", [], "no place in the order"),
    ],
)
def test_numbers_in_names_order_photographs_whose_neighbours_are_alike(
    names: list[str], rooms: str, order: list[int], text: str
) -> None:
    hues = dict(zip("ab", np.eye(2, COLOURS, dtype=np.uint8), strict=True))
    album = [
        replace(each, name=name, colours=hues[room])
        for each, name, room in zip(_album(*[("", None)] * len(names)), names, rooms, strict=True)
    ]
    found = walk_order(album, {})
    assert found.order[len(names) - len(order) :].tolist() == order
    assert found.follows.sum() == max(len(order) - 1, 0)
    assert text in found.warnings[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2024:05:01 10:20:30", datetime(2024, 5, 1, 10, 20, 30)),
        ("2024-05-01 10:20:30", datetime(2024, 5, 1, 10, 20, 30)),
        ("2024:05: 1  9: 3: 5", datetime(2024, 5, 1, 9, 3, 5)),
        ("2024:05:01 03:14:12 p. m.", datetime(2024, 5, 1, 15, 14, 12)),
        ("2024/5/1 3:20 PM", datetime(2024, 5, 1, 15, 20)),
        ("2024-05-01T10:20:30.5+02:00", datetime(2024, 5, 1, 8, 20, 30, 500_000, tzinfo=UTC)),
        ("2024:05:01 10:20:30 UTC", datetime(2024, 5, 1, 10, 20, 30, tzinfo=UTC)),
        ("2024:05:01 下午 03:14:12", datetime(2024, 5, 1, 15, 14, 12)),
        ("2024:05:01 24:05:12", datetime(2024, 5, 1, 0, 5, 12)),
        *((text, None) for text in ("0000:00:00 00:00:00", "    :  :     :  :  ", "2024:13:01 10:20:30", "2024:05:01")),
    ],
)
def test_times_are_read_in_the_forms_of_cameras(text: str, expected: datetime | None) -> None:
    assert read_time(text) == expected


def test_zone_and_fraction_of_a_time_can_be_tags_of_their_own() -> None:
    assert read_time("2024:05:01 10:20:30", "25", "-03:30") == datetime(2024, 5, 1, 13, 50, 30, 250_000, tzinfo=UTC)
    assert len({read_time("2024:05:01 10:20:30", "", zone) for zone in ("+2", "+0200", "+02:00")}) == 1
    assert read_time("2024:05:01 10:20:30", "", "+99:00") == datetime(2024, 5, 1, 10, 20, 30)


@pytest.mark.parametrize("name", [b"photoshop:DateCreated", b"xmp:CreateDate", b""])
def test_times_of_xmp_and_of_gps_count_without_others(name: bytes) -> None:
    exif, packets = Image.Exif(), [name + b">2026-05-01T12:00:30+02:00<"]
    if not name:
        exif.get_ifd(0x8825).update({29: "2026:05:01", 7: (10.0, 0.0, 30.9)})
    assert read_taken(exif, packets, width=0, height=0).at == _TEN.replace(second=30, tzinfo=UTC)
    exif.get_ifd(0x8769)[0x9003] = "2026:05:01 09:00:00"
    assert read_taken(exif, packets, width=0, height=0).at == datetime(2026, 5, 1, 9)
    exif.get_ifd(0x8769)[0x9010] = "+02:00"
    assert read_taken(exif, packets, width=0, height=0).at == datetime(2026, 5, 1, 7, tzinfo=UTC)


def _picture(path: Path, minute: int | None = None) -> None:
    exif = Image.Exif()
    if minute is not None:
        exif.get_ifd(0x8769)[0x9003] = f"2026:05:01 10:{minute:02d}:00"
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def test_turns_are_ordered_by_time_else_by_the_numbers_in_names(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        _picture(tmp_path / f"{number}.jpg")
    assert [file.stem for file in pictures_in(tmp_path)] == ["1", "2", "10"]
    assert [file.stem for file in turn_files(tmp_path)[0]] == ["1", "2", "10"]
    for number, minute in ((1, 5), (2, 3), (10, 4)):
        _picture(tmp_path / f"{number}.jpg", minute)
    assert [file.stem for file in turn_files(tmp_path)[0]] == ["2", "10", "1"]
    assert turn_files(tmp_path)[1] == []
    _picture(tmp_path / "2.jpg", 5)
    assert [file.stem for file in turn_files(tmp_path)[0]] == ["1", "2", "10"]
    assert turn_files(tmp_path)[1][0].startswith("1 of 3 photographs have no time of their own, so all are in the ord")


def test_empty_and_hidden_files_of_a_turn_are_left_out_and_named(tmp_path: Path) -> None:
    _picture(tmp_path / "1.jpg")
    for name in ("2.jpg", "._1.jpg", "3.gif"):
        (tmp_path / name).touch()
    used, left_out = turn_files(tmp_path)
    assert [file.name for file in used] == ["1.jpg"]
    assert [text.split("'")[1] for text in left_out] == ["2.jpg", "._1.jpg", "3.gif"]
