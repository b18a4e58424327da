"""Order of an album's photographs: the walk by the clocks of its cameras, else by the numbers in their names.

Photographs whose file states a time zone have instants. The clocks of other cameras can be set to any time: pairs of
photographs of one place, one by each of two cameras, tell the difference of the two, if enough of them agree. Where it
stays unknown, the order counts within each camera only. Numbers in names count for photographs without a time, if
neighbours look more alike than others do: most folders, and listings, have the pictures of a room beside each other.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from itertools import pairwise
from pathlib import PurePath

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.links import Found, is_one_place, similarity
from lalaloc_core.photograph.picture_folders import with_numbers

# Share of the photographs by a clock that must have a time for its order to count, and of those without a time whose
# names must be alike but for numbers; fewest of these.
_TIMED, _FEWEST = 0.8, 4
# Standard errors by which neighbours by name have more similar colours than all pairs; few shuffled albums pass.
_ALIKE = 1.2
# People go from one photograph to the next within this time (s); later ones are of another visit.
_VISIT_S = 3.0 * 3600.0
# Photographs of one place by two cameras are taken within this time (s); pairs that must agree on a difference.
_PLACE_S, _MIN_PAIRS, _MIN_SHARE = 300.0, 3, 0.5
# Smaller differences of clocks (s) are not reported; cameras that are named.
_SAME_S, _MAX_NAMED = 60.0, 5
_ZONED = "cameras with time zones"


@dataclass(frozen=True, eq=False)
class WalkOrder:
    """Order of n photographs.

    Attributes:
        order: (n,) numbers of the photographs, those of a walk in their order.
        follows: (n,) whether the photograph at that place of the order follows the one before it on a walk.
        warnings: what was assumed about clocks, and what was not used.
    """

    order: Int[np.ndarray, "n"]
    follows: Bool[np.ndarray, "n"]
    warnings: tuple[str, ...]


def walk_order(photographs: Sequence[AlbumPhotograph], links: Mapping[tuple[int, int], Found]) -> WalkOrder:
    """Return the order in which photographs were taken, as far as clocks or names tell; `links` are by their number."""
    cameras, taken = _cameras(photographs), [each.taken.at for each in photographs]
    zones = {camera: at.tzinfo for camera, at in zip(cameras, taken, strict=True) if at is not None and at.tzinfo}
    seconds, rows_of = _seconds(cameras, taken, zones), _clocks(cameras, zones)
    names = [name for name, rows in rows_of.items() if np.isfinite(seconds[rows]).mean() >= _TIMED]
    # Cameras with time zones are right, so the others are compared with them.
    names.sort(key=lambda name: name != _ZONED)
    clock = np.full(len(photographs), -1)
    for number, name in enumerate(names):
        clock[rows_of[name]] = number
    untimed = np.isnan(seconds)
    clock[untimed] = -1
    numbered = _numbered(photographs, untimed)
    is_walk = len(numbered) > 0 and _are_alike([photographs[row] for row in numbered])
    warnings = _on_missing(photographs, untimed, int(((clock < 0) & ~untimed).sum()), numbered, is_walk=is_walk)
    walk, ahead_s = _joined(len(names), _differences(seconds, clock, links))
    for number, (first, difference_s) in enumerate(zip(walk, ahead_s, strict=True)):
        if abs(difference_s) > _SAME_S:
            way = "ahead of" if difference_s > 0.0 else "behind"
            reference = "universal time" if names[first] == _ZONED else f"that of {names[first]}"
            warnings.append(
                f"the clock of {names[number]} is {timedelta(seconds=round(abs(difference_s)))} {way} {reference}, by "
                "photographs of the same places, which the order takes into account"
            )
    if len(set(walk)) > 1:
        more = f" and {len(names) - _MAX_NAMED} others" if len(names) > _MAX_NAMED else ""
        warnings.append(
            f"the clocks of {', '.join(names[:_MAX_NAMED])}{more} could not all be compared, so photographs are in "
            "order within each camera only: correct the times of one, or add photographs of the same places by both"
        )
    is_timed = clock >= 0
    of_walk = np.where(is_timed, np.array([*walk, -1])[clock], -1)
    seconds = seconds - np.where(is_timed, np.array([*ahead_s, 0.0])[clock], 0.0)
    if is_walk:
        of_walk[numbered], seconds[numbered] = len(names), np.arange(len(numbered))
    order = np.lexsort((np.nan_to_num(seconds), of_walk))
    follows = np.zeros(len(order), bool)
    before, after = order[:-1], order[1:]
    near = np.abs(seconds[after] - seconds[before]) <= _VISIT_S
    follows[1:] = (of_walk[before] == of_walk[after]) & (of_walk[after] >= 0) & near
    return WalkOrder(order, follows, tuple(warnings))


def _numbered(photographs: Sequence[AlbumPhotograph], untimed: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """Return the photographs without a time in the order of the numbers in their names; none if names differ more."""
    alike: defaultdict[str, list[int]] = defaultdict(list)
    for row in np.flatnonzero(untimed).tolist():
        alike[re.sub(r"\d+", "#", PurePath(photographs[row].name).stem.lower())].append(row)
    fewest = max(_FEWEST, _TIMED * untimed.sum())
    rows = next((rows for text, rows in alike.items() if "#" in text and len(rows) >= fewest), [])
    # Different files with one name have no order.
    of_name = {photographs[row].name: row for row in rows}
    is_order = len(of_name) == len(rows)
    return np.array([of_name[name] for name in sorted(of_name, key=with_numbers)] if is_order else [], int)


def _are_alike(photographs: Sequence[AlbumPhotograph]) -> bool:
    """Return whether neighbours have more similar colours than all pairs; true if colours of too few are known."""
    known = [photograph for photograph in photographs if photograph.colours.any()]
    if len(known) < _FEWEST:
        return True
    similar = similarity(known)
    every, neighbours = similar[np.triu_indices(len(known), 1)], np.diag(similar, 1)
    error = float(every.std()) / math.sqrt(len(neighbours))
    return float(neighbours.mean() - every.mean()) >= _ALIKE * error


def _on_missing(
    photographs: Sequence[AlbumPhotograph],
    untimed: Bool[np.ndarray, "n"],
    dropped: int,
    numbered: Int[np.ndarray, "m"],
    *,
    is_walk: bool,
) -> list[str]:
    """Return warnings on photographs without a time, and on those whose time is not used."""
    found, count = [], len(photographs)
    if untimed.any():
        text = f"{untimed.sum()} of {count} photographs have no time of their own, so no place in the order"
        if len(numbered):
            first, last = (photographs[row].name for row in (numbered[0], numbered[-1]))
            text = f"{untimed.sum()} of {count} photographs have no time of their own: " + (
                f"{len(numbered)} are in the order of the numbers in their names, from '{first}' to '{last}'"
                if is_walk
                else "the numbers in their names tell no order, as neighbours look no more alike than others"
            )
        found.append(f"{text}; send the original files")
    if dropped:
        found.append(
            f"the times of {dropped} of {count} photographs were not used, because fewer than {_TIMED:.0%} of their "
            "camera's photographs have one"
        )
    return found


def _cameras(photographs: Sequence[AlbumPhotograph]) -> list[str]:
    """Return the camera of each photograph, by maker and model, and of several of one model by its first photograph."""
    of_model: defaultdict[str, list[int]] = defaultdict(list)
    for row, each in enumerate(photographs):
        of_model[" ".join(filter(None, (each.taken.make, each.taken.model))) or "an unknown camera"].append(row)
    cameras = [""] * len(photographs)
    for model, rows in of_model.items():
        for row, first in zip(rows, _first_of_runs([photographs[row] for row in rows]), strict=True):
            cameras[row] = f"{model} (of '{first}')" if first else model
    return cameras


def _first_of_runs(photographs: Sequence[AlbumPhotograph]) -> list[str]:
    """Return the first name of each photograph's run, which ends where times go back along names, or these change.

    Runs are of cameras of one model whose clocks differ if their times are apart; if not, the names are empty.
    """
    firsts, times, first, before = [""] * len(photographs), list[list[datetime]]([[]]), "", ""
    for row in sorted(range(len(firsts)), key=lambda row: with_numbers(photographs[row].name)):
        name, at = photographs[row].name, photographs[row].taken.at
        at, begin = at and at.replace(tzinfo=None), re.sub(r"\d.*", "", PurePath(name).stem.lower())
        if times[-1] and (begin != before or (at and (times[-1][-1] - at).total_seconds() > _SAME_S)):
            times.append([])
        firsts[row] = first = first if times[-1] else name
        times[-1] += [] if at is None else [at]
        before = begin
    spans = sorted((min(each), max(each)) for each in times if len(each) >= _MIN_PAIRS)
    is_apart = len(spans) == len(times) > 1 and all(last < first for (_, last), (first, _) in pairwise(spans))
    return firsts if is_apart else [""] * len(firsts)


def _seconds(
    cameras: Sequence[str], taken: Sequence[datetime | None], zones: Mapping[str, tzinfo]
) -> Float[np.ndarray, "n"]:
    """Return the times of photographs, of those without a time zone by the camera's clock; NaN without any.

    A time that all of a camera's photographs have is not theirs.
    """
    seconds = np.full(len(taken), np.nan)
    for number, (camera, at) in enumerate(zip(cameras, taken, strict=True)):
        if at is not None:
            seconds[number] = at.replace(tzinfo=at.tzinfo or zones.get(camera, UTC)).timestamp()
    for rows in _clocks(cameras, {}).values():
        if len(rows) >= _MIN_PAIRS and len(np.unique(seconds[rows])) == 1:
            seconds[rows] = np.nan
    return seconds


def _clocks(cameras: Sequence[str], zones: Mapping[str, tzinfo]) -> dict[str, Int[np.ndarray, "m"]]:
    """Return the numbers of the photographs by clock; cameras that state time zones have one clock together."""
    found: dict[str, list[int]] = {}
    for number, camera in enumerate(cameras):
        found.setdefault(_ZONED if camera in zones else camera, []).append(number)
    return {name: np.array(rows) for name, rows in found.items()}


def _differences(
    seconds: Float[np.ndarray, "n"], clock: Int[np.ndarray, "n"], links: Mapping[tuple[int, int], Found]
) -> dict[tuple[int, int], float]:
    """Return how far the second clock of a pair is ahead of the first (s), where photographs of one place tell it."""
    apart: defaultdict[tuple[int, int], list[float]] = defaultdict(list)
    for (first, second), found in links.items():
        if min(clock[first], clock[second]) >= 0 and clock[first] != clock[second] and is_one_place(found):
            early, late = sorted((first, second), key=lambda number: clock[number])
            apart[int(clock[early]), int(clock[late])].append(seconds[late] - seconds[early])
    agreed = {pair: _agreed(np.sort(values)) for pair, values in apart.items()}
    return {pair: difference_s for pair, difference_s in agreed.items() if difference_s is not None}


def _agreed(sorted_s: Float[np.ndarray, "n"]) -> float | None:
    """Return the value on which enough of the differences agree; None without one."""
    last = np.searchsorted(sorted_s, sorted_s + _PLACE_S, side="right")
    begin = int((last - np.arange(len(last))).argmax())
    agreeing = sorted_s[begin : last[begin]]
    return float(np.median(agreeing)) if len(agreeing) >= max(_MIN_PAIRS, _MIN_SHARE * len(sorted_s)) else None


def _joined(count: int, differences_s: Mapping[tuple[int, int], float]) -> tuple[list[int], list[float]]:
    """Return the first clock that each is compared with, also through others, and how far it is ahead of it (s)."""
    ways: defaultdict[int, list[tuple[int, float]]] = defaultdict(list)
    for (first, second), difference_s in differences_s.items():
        ways[first].append((second, difference_s))
        ways[second].append((first, -difference_s))
    walk, ahead_s = [-1] * count, [0.0] * count
    for root in range(count):
        pending = [root] if walk[root] < 0 else []
        while pending:
            number = pending.pop()
            walk[number] = root
            for neighbour, difference_s in ways[number]:
                if walk[neighbour] < 0:
                    ahead_s[neighbour] = ahead_s[number] + difference_s
                    pending.append(neighbour)
    return walk, ahead_s
