"""Chains of pictures: sums over all paths through their states, and the best paths (Rabiner 1989).

All pictures share one camera height. The chain is summed once for every height that is tried, and the probability of a
height is proportional to the likelihood of all pictures at it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from lalaloc_core.localise.sequence.measured_motion import Transition

# Pairs of places and headings compared at a time, few enough to stay in the processor's cache.
_COMPARED = 100_000


@dataclass(frozen=True, eq=False)
class Marginals:
    """Marginal probabilities of a chain.

    Attributes:
        log_evidence: log of the sum over all paths and heights.
        state: for every picture the (n, k) probability of its states; the sum is one.
    """

    log_evidence: float
    state: list[Float[np.ndarray, "_ _"]]
    height: Float[np.ndarray, "j"]


def forward_backward(
    log_likelihood: Sequence[Float[np.ndarray, "j _ _"]],
    transitions: Sequence[Transition],
    log_prior: Float[np.ndarray, "j"],
) -> Marginals:
    """Sum over all paths.

    `log_likelihood` is by height and state for every picture; `transitions` are between neighbours, and `log_prior` is
    that of the heights.
    """
    peak = [float(values.max()) for values in log_likelihood]
    likelihood = [np.exp(values - top) for values, top in zip(log_likelihood, peak, strict=True)]
    forward, log_sum = [], log_prior + sum(peak)
    message = np.ones((len(log_prior), 1, 1))
    for index, values in enumerate(likelihood):
        if index:
            message = _onwards(transitions[index - 1], forward[-1])
        joint, log_scale = _scaled(message * values)
        log_sum = log_sum + log_scale
        forward.append(joint)
    log_evidence = float(np.logaddexp.reduce(log_sum))
    height = np.exp(log_sum - log_evidence)
    state = [np.empty(0)] * len(forward)
    behind = np.ones((len(log_prior), 1, 1))
    for index in reversed(range(len(forward))):
        if index + 1 < len(forward):
            behind = _scaled(_back(transitions[index], behind * likelihood[index + 1]))[0]
        both = forward[index] * behind
        total = both.sum(axis=(1, 2), keepdims=True)
        state[index] = (both * (height[:, None, None] / np.where(total > 0.0, total, 1.0))).sum(axis=0)
    return Marginals(log_evidence, state, height)


def _scaled(values: Float[np.ndarray, "j n k"]) -> tuple[Float[np.ndarray, "j n k"], Float[np.ndarray, "j"]]:
    """Scale values to a sum of one for each height; return them and the logs of the former sums."""
    total = values.sum(axis=(1, 2))
    safe = np.where(total > 0.0, total, 1.0)
    with np.errstate(divide="ignore"):
        return values / safe[:, None, None], np.log(total)


def _onwards(transition: Transition, message: Float[np.ndarray, "j n k"]) -> Float[np.ndarray, "j m l"]:
    """Sum over the states of the first picture of a transition."""
    _, _, m, after = transition.sizes
    places, turns = transition.places, transition.turns
    turned = _sum_over_turns(_sum_over_places(message, places, m, transition.is_directed), turns, after)
    return turned + transition.floor * message.sum(axis=(1, 2), keepdims=True)


def _back(transition: Transition, message: Float[np.ndarray, "j m l"]) -> Float[np.ndarray, "j n k"]:
    """Sum over the states of the second picture of a transition."""
    n, k, _, _ = transition.sizes
    turned = _sum_over_turns(message, None if transition.turns is None else transition.turns.T, k)
    places = None if transition.places is None else transition.places.T
    placed = _sum_over_places(turned, places, n, transition.is_directed)
    return placed + transition.floor * message.sum(axis=(1, 2), keepdims=True)


def _sum_over_places(
    message: Float[np.ndarray, "j n k"], places: Any, count: int, is_directed: bool
) -> Float[np.ndarray, "j m k"]:
    """Sum over places, for `count` other ones; `places` are the likelihoods of pairs."""
    heights, _, k = message.shape
    if places is None:
        return np.broadcast_to(message.sum(axis=1, keepdims=True), (heights, count, k))
    if is_directed:
        return (places @ message.reshape(heights, -1).T).T.reshape(heights, count, k)
    columns = message.transpose(1, 0, 2).reshape(message.shape[1], -1)
    return (places @ columns).reshape(count, heights, k).transpose(1, 0, 2)


def _sum_over_turns(
    message: Float[np.ndarray, "j n k"], turns: Float[np.ndarray, "k l"] | None, count: int
) -> Float[np.ndarray, "j n l"]:
    """Sum over headings, for `count` other ones; `turns` are the likelihoods of pairs."""
    if turns is None:
        return np.broadcast_to(message.sum(axis=2, keepdims=True), (*message.shape[:2], count))
    return message @ turns


@dataclass(frozen=True, eq=False)
class BestPaths:
    """Best path through every state of every picture.

    Attributes:
        score: for every picture the (n, k) log likelihood of the best path through each state.
        before, after: for every picture the (n, k) state of its neighbour on that path, in row-major order.
    """

    score: list[Float[np.ndarray, "_ _"]]
    before: list[Int[np.ndarray, "_ _"]]
    after: list[Int[np.ndarray, "_ _"]]

    def through(self, picture: int, state: int) -> list[int]:
        """Return the best path through a state of a picture."""
        path = [state]
        for index in range(picture, 0, -1):
            path.insert(0, int(self.before[index].ravel()[path[0]]))
        for index in range(picture, len(self.score) - 1):
            path.append(int(self.after[index].ravel()[path[-1]]))
        return path


def best_paths(log_likelihood: Sequence[Float[np.ndarray, "_ _"]], transitions: Sequence[Transition]) -> BestPaths:
    """Find the best paths by Viterbi's algorithm in both directions, at one height."""
    count = len(log_likelihood)
    reached, left = list(log_likelihood), [np.zeros_like(values) for values in log_likelihood]
    nothing = [np.full(values.shape, -1) for values in log_likelihood]
    before, after = list(nothing), list(nothing)
    for index in range(1, count):
        best, before[index] = _best_onwards(transitions[index - 1], reached[index - 1])
        reached[index] = best + log_likelihood[index]
    for index in reversed(range(count - 1)):
        left[index], after[index] = _best_back(transitions[index], left[index + 1] + log_likelihood[index + 1])
    return BestPaths(
        [sum_before + sum_after for sum_before, sum_after in zip(reached, left, strict=True)], before, after
    )


_Best = tuple[Float[np.ndarray, "_ _"], Int[np.ndarray, "_ _"]]


def _best_onwards(transition: Transition, score: Float[np.ndarray, "n k"]) -> _Best:
    """Return the best first state for every second state of a transition."""
    _, k, m, after = transition.sizes
    placed, place = _best_place(transition, score, m)
    turned, heading = _best_heading(placed, transition.turns, after)
    state = np.take_along_axis(place, heading, axis=1) * k + heading
    return _or_floor(transition, score, turned, state)


def _best_back(transition: Transition, score: Float[np.ndarray, "m l"]) -> _Best:
    """Return the best second state for every first state of a transition."""
    n, k, _, after = transition.sizes
    turned, heading = _best_heading(score, None if transition.turns is None else transition.turns.T, k)
    placed, place = _best_place(transition, turned, n, backwards=True)
    state = place * after + np.take_along_axis(heading, place, axis=0)
    return _or_floor(transition, score, placed, state)


def _or_floor(
    transition: Transition,
    score: Float[np.ndarray, "n k"],
    found: Float[np.ndarray, "m l"],
    state: Int[np.ndarray, "m l"],
) -> _Best:
    """Replace results below the transition's floor by the best state of all at the floor."""
    if not transition.floor:
        return found, state
    anywhere = float(score.max()) + np.log(transition.floor)
    wrong = found < anywhere
    return np.where(wrong, anywhere, found), np.where(wrong, int(score.argmax()), state)


def _best_heading(score: Float[np.ndarray, "n k"], turns: Float[np.ndarray, "k l"] | None, headings: int) -> _Best:
    """Return the best heading before for every heading after, place by place."""
    if turns is None:
        best = score.argmax(axis=1)[:, None]
        value = np.take_along_axis(score, best, axis=1)
        return np.repeat(value, headings, axis=1), np.repeat(best, headings, axis=1)
    with np.errstate(divide="ignore"):
        log_turns = np.log(turns).T
    value, best = np.empty((len(score), headings)), np.empty((len(score), headings), int)
    step = max(_COMPARED // log_turns.size, 1)
    for first in range(0, len(score), step):
        pairs = score[first : first + step, None, :] + log_turns[None]
        best[first : first + step] = pairs.argmax(axis=2)
        value[first : first + step] = pairs.max(axis=2)
    return value, best


def _best_place(
    transition: Transition, score: Float[np.ndarray, "n k"], places: int, *, backwards: bool = False
) -> _Best:
    """Return the best place before for every place after, heading by heading of the first picture."""
    headings = score.shape[1]
    if transition.places is None:
        best = score.argmax(axis=0)[None]
        value = np.take_along_axis(score, best, axis=0)
        return np.repeat(value, places, axis=0), np.repeat(best, places, axis=0)
    pairs = transition.places.T.tocsr() if backwards else transition.places
    if transition.is_directed:
        value, best = _best_of_rows(pairs, score.reshape(-1, 1))
        return value.reshape(places, headings), best.reshape(places, headings) // headings
    return _best_of_rows(pairs, score)


def _best_of_rows(pairs: csr_array, score: Float[np.ndarray, "n k"]) -> _Best:
    """Return the best `log value + score` over the entries of every row of a sparse matrix, and its column."""
    rows, columns = len(pairs.indptr) - 1, score.shape[1]
    value, best = np.full((rows, columns), -np.inf), np.zeros((rows, columns), int)
    filled = np.flatnonzero(np.diff(pairs.indptr))
    if not len(filled):
        return value, best
    row_of = np.repeat(np.arange(len(filled)), np.diff(pairs.indptr)[filled])
    log_value, begins = np.log(pairs.data), pairs.indptr[filled]
    step = max(_COMPARED // len(log_value), 1)
    for first in range(0, columns, step):
        part = slice(first, first + step)
        total = log_value[:, None] + score[pairs.indices, part]
        highest = np.maximum.reduceat(total, begins, axis=0)
        value[filled, part] = highest
        # The last of equal entries wins: every entry that equals the row's best writes its column.
        entry, column = np.nonzero(total >= highest[row_of])
        best[filled[row_of[entry]], first + column] = pairs.indices[entry]
    return value, best
