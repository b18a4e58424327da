"""Solve of an album: the pins of all photographs at once.

Each photograph is compared with the plan alone (`evidence.py`); this is kept in the `AlbumMemory`. Overlap, compasses
and corrections then change the evidence (`states.py`), and all photographs are assigned to rooms together
(`room_assignment.py`), by their own evidence, the walk from one to the next, and the pairs that look as if they are of
one room (`links.py`). Within its room, a photograph is at the pose that fits it best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import AlbumWeights
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.evidence import (
    AlbumMemory,
    SearchedPlan,
    camera_height,
    room_types,
    shared_cameras,
    single_evidence,
    types_by_names,
)
from lalaloc_core.localise.album.ground import AlbumGround, Constraint, constraint_of
from lalaloc_core.localise.album.links import Found, find_links, pair_odds
from lalaloc_core.localise.album.pins import Album, Pin, Suggestion
from lalaloc_core.localise.album.room_assignment import RoomEvidence, assign_rooms, expected_shares, storeys_of, walk_of
from lalaloc_core.localise.album.states import States, by_compass, turned_together
from lalaloc_core.localise.album.walk_order import WalkOrder, walk_order
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.photograph.picture_folders import with_numbers

MAX_PHOTOGRAPHS = 500
# The comparison with poses takes memory by their number, the walk from room to room time by the cube of theirs.
MAX_POSES, MAX_ROOMS = 65_536, 1000
# Pins whose room is right with at least this probability are sure.
SURE = 0.8
_SUGGESTIONS, _ROOMS = 5, 8
# The usual share of misread photographs counts like so many photographs; rounds of expectation maximisation; and the
# limit of the log odds that a room is right, either way.
_SEEN_BEFORE, _ROUNDS, _MAX_LOG_ODDS = 10.0, 20, 6.0
_MISFIT_WARNING = (
    "the photographs fit this plan badly: walls and openings of {:.0f} % of them agree with it no better than with "
    "other homes, so none is sure; check that it is the plan of this home, its scale, and that it draws the doors and "
    "windows"
)
_ELSEWHERE = "it fits none of the rooms of the plan better than rooms of other buildings"
_OUTSIDE = "no furniture or fittings are recognised in it, as in photographs of façades and gardens"
_CERTAIN = 1e4


def solve_album(
    ground: AlbumGround,
    encoder: PhotographEncoder,
    photographs: Sequence[AlbumPhotograph],
    *,
    memory: AlbumMemory | None = None,
    progress: Callable[[int], object] = lambda _: None,
    pause: Callable[[], object] = lambda: None,
) -> Album:
    """Pin the photographs of an album.

    Args:
        ground: the plan, or the plans of a venue.
        encoder: encoder of the model that the entries were made with.
        photographs: at most 500, with different ids; their order does not matter.
        memory: what earlier solves found, filled in place; None for nothing.
        progress: called with the number of photographs that were compared with the plan.
        pause: called often, after at most a photograph's comparison; what it raises ends the solve.
    """
    _check(ground, photographs)
    constraints = {each.id: constraint_of(ground, each) for each in photographs if each.correction is not None}
    memory = AlbumMemory() if memory is None else memory
    memory.use(ground, encoder.manifest)
    memory.keep({each.id for each in photographs})
    if not photographs:
        return Album(pins=())
    ordered = sorted(photographs, key=_place_in_order)
    if new := [each for each in ordered if each.id not in memory.evidence]:
        searched = SearchedPlan.of(ground.plan, ground.grid, encoder.manifest.profile_columns)
        for each in new:
            memory.evidence[each.id] = single_evidence(searched, encoder, each.photograph)
            progress(len(memory.evidence))
            pause()
    links = find_links(ordered, memory, pause)
    states, bias = _states(ground, encoder, ordered, memory, links)
    weights = encoder.manifest.album
    walk = walk_order(ordered, links)
    seen = (encoder.seen_objects([(each.photograph, 0.0)]) for each in ordered)
    # Log likelihood ratios of a photograph taken outside to one of a room; 0 if no objects are known.
    outside = np.array([0.0 if objects is None else objects.outside for objects in seen])
    # What a person stated, and what is taken outside, does not tell how well the plan is read.
    telling = [
        state.rooms / state.photographs
        for each, state, odds in zip(ordered, states, outside, strict=True)
        if each.id not in constraints and odds <= 0.0
    ]
    misread = misread_share(telling, weights.misread)
    named = types_by_names(ground.plan, ordered)
    own = named + [
        state.evidence(misread) + room_types(ground.plan, encoder, each.photograph, memory.evidence[each.id])
        for each, state in zip(ordered, states, strict=True)
    ]
    pairs = weights.pairs * pair_odds(ordered, links)
    share = _room_shares(ground, ordered, own, outside, constraints, walk, pairs, weights.crowding, pause)
    misfit = () if misread <= weights.misfit else (_MISFIT_WARNING.format(100.0 * misread),)
    share = calibrated(share, misread, weights)
    pins = {
        each.id: _pin(ground, each, state, row, constraints.get(each.id), fits=not misfit, is_outside=odds > 0.0)
        for each, state, row, odds in zip(ordered, states, share, outside, strict=True)
    }
    height_m, scale = camera_height(ground, [memory.evidence[each.id] for each in ordered])
    north = ground.plan.north
    return Album(
        pins=tuple(pins[each.id] for each in photographs),
        cameras=shared_cameras(ordered),
        camera_height_m=height_m,
        scale=scale,
        compass_bias=bias if bias is None or north is None else math.remainder(bias - north, math.tau),
        misread=misread,
        warnings=(*misfit, *walk.warnings, *_on_names(ordered, named)),
    )


def _on_names(photographs: Sequence[AlbumPhotograph], named: Float[np.ndarray, "n r"]) -> tuple[str, ...]:
    told = [each.name for each, row in zip(photographs, named, strict=True) if row.any()]
    if not told:
        return ()
    return (
        f"{len(told)} of {len(named)} names tell the type of the room, as '{told[0]}': rename files if they do not",
    )


def _place_in_order(photograph: AlbumPhotograph) -> tuple[datetime, list[str], str]:
    """Return what orders photographs before their clocks are compared."""
    return (photograph.taken.at or datetime.max).replace(tzinfo=None), with_numbers(photograph.name), photograph.id


def misread_share(rooms: Sequence[Float[np.ndarray, "r"]], usual: float) -> float:
    """Return the share of photographs whose walls and openings fit the plan no better than other homes.

    It is found by expectation maximisation, with a prior of its usual value, from the log likelihood of every room for
    each photograph (`States.rooms`): how well plans are drawn and photographs are read differs between homes.
    """
    ratio = np.array([np.logaddexp.reduce(each) - math.log(len(each)) for each in rooms])
    share = usual
    for _ in range(_ROUNDS):
        misread = 1.0 / (1.0 + np.exp(np.clip(math.log1p(-share) - math.log(share) + ratio, -50.0, 50.0)))
        share = (float(misread.sum()) + _SEEN_BEFORE * usual) / (len(ratio) + _SEEN_BEFORE)
    return share


def calibrated(share: Float[np.ndarray, "n s"], misread: float, weights: AlbumWeights) -> Float[np.ndarray, "n s"]:
    """Return the probabilities of rooms (the last is none of them), that of the best one as often right as it says.

    The order stays; where the sum of a row is less than one, the rest is what the photographs cannot tell. Photographs
    that are probably of none of the rooms keep their row.
    """
    each, best = np.arange(len(share)), share[:, :-1].argmax(axis=1)
    top = share[each, best]
    bias, by_share, by_misread = weights.confidence
    confidence = 1.0 / (1.0 + np.exp(-bias - by_share * log_odds(top) - by_misread * misread))
    left = (1.0 - confidence) / np.maximum(1.0 - top, 1e-9)
    found = share * np.minimum(confidence / np.maximum(top, 1e-9), left)[:, None]
    found[each, best] = confidence
    found[:, -1] = share[:, -1] * np.minimum(left, 1.0)
    return np.where(share[:, -1:] > 0.5, share, found)


def log_odds(probability: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the log odds of probabilities, at most 6 either way."""
    smallest = 1.0 / (1.0 + math.exp(_MAX_LOG_ODDS))
    kept = np.clip(probability, smallest, 1.0 - smallest)
    return np.log(kept / (1.0 - kept))


def _check(ground: AlbumGround, photographs: Sequence[AlbumPhotograph]) -> None:
    """Check the sizes of an album and its ground."""
    if len(photographs) > MAX_PHOTOGRAPHS:
        raise InvalidInputError(f"the album has {len(photographs)} photographs; the limit is {MAX_PHOTOGRAPHS}")
    poses, rooms = len(ground.grid.poses), len(ground.plan.rooms)
    if poses > MAX_POSES or rooms > MAX_ROOMS:
        raise InvalidInputError(
            f"the place has {rooms} rooms and {poses} grid poses; albums search at most {MAX_ROOMS} rooms and "
            f"{MAX_POSES} poses, about 16,000 m²: upload the parts as plans of their own"
        )
    if len({photograph.id for photograph in photographs}) < len(photographs):
        raise InvalidInputError("two photographs of the album have the same id; every photograph is added once")


def _states(
    ground: AlbumGround,
    encoder: PhotographEncoder,
    photographs: Sequence[AlbumPhotograph],
    memory: AlbumMemory,
    links: dict[tuple[int, int], Found],
) -> tuple[list[States], float | None]:
    """Return the states of all photographs, with overlap and compasses, and the bias of the compass."""
    manifest = encoder.manifest
    states = [
        States.of(
            memory.evidence[each.id], manifest.ring_sectors if each.photograph.is_sphere else manifest.profile_columns
        )
        for each in photographs
    ]
    turns = {pair: turn for pair, (_, turn) in links.items() if not math.isnan(turn)}
    poses = max(int(state.pose.max()) for state in states) + 1
    states, bias = by_compass(states, [each.photograph.compass_heading for each in photographs], ground.plan.north)
    return turned_together(states, turns, poses), bias


def _room_shares(
    ground: AlbumGround,
    photographs: Sequence[AlbumPhotograph],
    own: Float[np.ndarray, "n r"],
    outside: Float[np.ndarray, "n"],
    constraints: dict[str, Constraint],
    walk: WalkOrder,
    pairs: Float[np.ndarray, "n n"],
    crowding: float,
    pause: Callable[[], object],
) -> Float[np.ndarray, "n s"]:
    """Return the probability of every room for every photograph; the last is none of the rooms.

    `own` is the log likelihood of each photograph in each room, and `outside` that outside over that in a room.
    """
    rooms = len(ground.plan.rooms)
    # Half of the photographs of none of the rooms are taken outside.
    alone = np.column_stack([own, np.logaddexp(0.0, outside) - math.log(2.0)])
    for number, each in enumerate(photographs):
        if each.id in constraints:
            wanted = constraints[each.id].room
            alone[number] -= _CERTAIN
            alone[number, rooms if wanted is None else wanted] += _CERTAIN
    alone = np.maximum(alone, -2.0 * _CERTAIN)
    order, follows = walk.order, walk.follows
    alone = alone[order]
    # Large rooms are photographed more often than closets; it counts by half, as numbers of photographs tell it too.
    expected = expected_shares(ground)
    alone[:, :rooms] += 0.5 * np.log(rooms * expected)
    # Without a photograph before it, each is of any room.
    alone[~follows, :rooms] -= math.log(rooms)
    evidence = RoomEvidence(
        alone=alone,
        walk=walk_of(ground) if follows.any() else None,
        follows=follows,
        pairs=pairs[np.ix_(order, order)],
        # Albums of fewer photographs than rooms have no expectation.
        expected=expected if len(photographs) >= rooms else None,
        crowding=crowding,
        storeys=storeys_of(ground),
    )
    share = np.empty(alone.shape)
    share[order] = assign_rooms(evidence, pause=pause)
    return share


def _pin(
    ground: AlbumGround,
    photograph: AlbumPhotograph,
    states: States,
    share: Float[np.ndarray, "s"],
    constraint: Constraint | None,
    *,
    fits: bool,
    is_outside: bool,
) -> Pin:
    """Return the pin of a photograph by the probabilities of its rooms."""
    rooms = len(ground.plan.rooms)
    ranked = np.argsort(-share[:rooms], kind="stable")[:_ROOMS].tolist()
    order = ranked[:1] + [room for room in ranked[1:] if share[room] > 1e-3]
    choices = [
        Suggestion(
            pose=ground.pose(states.position_m[row], room, float(states.heading[row])),
            probability=float(share[room] * part),
        )
        for room in order
        for row, part in zip(*states.modes(room), strict=True)
    ]
    # The best place of the most probable room comes first: rooms are surer than places.
    choices = choices[:1] + sorted(choices[1:], key=lambda choice: -choice.probability)
    suggestions = tuple(choices[:_SUGGESTIONS])
    listed = tuple(ground.share(room, float(share[room])) for room in order)
    base = Pin(
        photograph_id=photograph.id,
        state="uncertain",
        pose=None,
        confidence=0.0,
        within_1m=0.0,
        elsewhere=float(share[rooms]),
        rooms=listed,
        suggestions=suggestions,
        warnings=photograph.photograph.warnings,
    )
    if constraint is not None:
        return _corrected(ground, base, constraint)
    # Photographs of a home that is read badly fit elsewhere better, all of them.
    is_elsewhere = share[rooms] > 0.5 and (fits or is_outside)
    if is_elsewhere or not suggestions:
        return replace(base, state="set_aside", reason=_OUTSIDE if is_outside else _ELSEWHERE)
    confidence = float(share[order[0]])
    is_sure = fits and confidence >= SURE
    also = ", ".join(f"{row.room} {100.0 * row.probability:.0f} %" for row in listed[1:3] if row.probability >= 0.005)
    reason = f"it also fits: {also}" if also else "the photographs fit this plan badly" if not fits else ""
    return replace(
        base,
        state="sure" if is_sure else "uncertain",
        pose=suggestions[0].pose,
        confidence=confidence,
        within_1m=suggestions[0].probability,
        reason="" if is_sure else reason,
    )


def _corrected(ground: AlbumGround, base: Pin, constraint: Constraint) -> Pin:
    """Return the pin of a photograph whose place a person stated."""
    if constraint.room is None:
        stated = replace(base, state="set_aside", rooms=(), suggestions=(), confidence=1.0)
        return replace(stated, reason="a person stated that it is of none of the rooms")
    pose = next((row.pose for row in base.suggestions), None)
    if constraint.position_m is not None:
        heading = constraint.heading
        if heading is None and pose is not None:
            heading = pose.heading
        pose = ground.pose(constraint.position_m, constraint.room, heading)
    suggestions = () if pose is None else (Suggestion(pose=pose, probability=1.0),)
    within_1m = 1.0 if constraint.position_m is not None else base.suggestions[0].probability if suggestions else 0.0
    return replace(
        base,
        state="corrected",
        pose=pose,
        confidence=1.0,
        within_1m=within_1m,
        suggestions=suggestions + base.suggestions[1:],
    )
