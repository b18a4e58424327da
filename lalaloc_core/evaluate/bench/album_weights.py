"""Weights of the evidence in albums, measured together on albums of pictures by others and of generated homes.

The temperature of walls and openings, the share of misread photographs, the weight of pairs, and that of the numbers of
photographs by room replace each other in part, so all combinations are tried. The sources are a furnished house, alone
and with photographs of elsewhere, annotated and path-traced rooms, and generated homes with and without furniture; they
count alike, whatever the number of their albums. The score is the mean log probability of the right room. Albums in the
plans of other homes are measured beside them: none of their pins should be sure.
"""

from __future__ import annotations

import multiprocessing
from collections import defaultdict
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice, product
from typing import Any

import numpy as np
from scipy import optimize

from lalaloc_core.bundle import AlbumWeights, Bundle, Manifest
from lalaloc_core.evaluate.bench.albums import galleries, home_album
from lalaloc_core.evaluate.bench.house import house_albums
from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.runs.albums import RoomAlbum, pin_figures
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.album.solve import log_odds
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder

# Most albums of a source.
_MOST = 8
_TEMPERATURES, _MISREAD = (1.0, 0.5, 0.25), (0.1, 0.2)
# Pairs draw photographs together, crowding apart.
_PAIRS_CROWDING = ((0.3, 1.6), (0.3, 3.2), (0.6, 0.8), (0.6, 1.6), (0.6, 3.2), (1.2, 3.2))
# Names of albums in the plans of other homes begin so; their weight beside a source of its own plans; ridge.
_FOREIGN, _OTHERS, _RIDGE = "foreign", 0.11, 1e-4


@dataclass(frozen=True, kw_only=True)
class Combination:
    """Factor of the bundle's temperature of views, and fields of `AlbumWeights`; confidence is the share."""

    temperature: float
    misread: float
    pairs: float
    crowding: float

    def changed(self, manifest: Manifest) -> Manifest:
        """Return a manifest with these weights."""
        view = manifest.view
        if view is not None:
            before = manifest.evidence_for(view=True)
            view = replace(view, evidence=replace(before, temperature=self.temperature * before.temperature))
        album = AlbumWeights(
            misread=self.misread, misfit=1.0, pairs=self.pairs, crowding=self.crowding, confidence=(0.0, 1.0, 0.0)
        )
        return replace(manifest, view=view, album=album)


Figures = dict[str, float]
Rows = Mapping[Combination, Mapping[str, Figures]]
# Figures of an album, and for each of its pins 1, the share of its room, the album's misread and whether it is right.
_Result = tuple[Figures, list[tuple[float, float, float, bool]]]


def bench_album_weights(setting: Setting) -> dict[str, Any]:
    """Measure all combinations of weights.

    Returns:
        `rows`, the figures of every combination by source; `chosen`, the one with the best score; `left_out`, by source
        the one with the best score of the other sources; and `confidence` fitted to the pins of the chosen one, a tenth
        of which are in the plans of other homes.
    """
    solved: defaultdict[Combination, defaultdict[str, list[_Result]]] = defaultdict(lambda: defaultdict(list))
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for source, found in pool.map(partial(_solved, setting.bundle), _albums(setting)):
            for weights, album in found.items():
                solved[weights][source].append(album)
    rows = {
        weights: {source: _total([figures for figures, _ in albums]) for source, albums in row.items()}
        for weights, row in solved.items()
    }
    sources = sorted({source for row in rows.values() for source in row if not source.startswith(_FOREIGN)})
    chosen = _best(rows, sources)
    without = {source: _best(rows, [each for each in sources if each != source]) for source in sources}
    return {
        "chosen": _row(chosen, rows[chosen]),
        "left_out": {source: _row(weights, rows[weights]) for source, weights in without.items()},
        "confidence": _fitted_confidence(solved[chosen]),
        "rows": [_row(weights, row) for weights, row in rows.items()],
    }


def _albums(setting: Setting) -> Iterator[tuple[str, RoomAlbum]]:
    houses = house_albums(setting)
    for name, album in houses.items():
        yield ("house" if None not in album.rooms else name), album
    homes = range(min(setting.homes, _MOST))
    cases = {
        "homes": (home_album(setting, home, split="validation") for home in homes),
        "empty_homes": (home_album(setting, home, split="validation", furniture="empty") for home in homes),
        **galleries(setting),
    }
    before: RoomAlbum | None = None
    for name, each in cases.items():
        for case in islice(each, _MOST):
            album = case.with_rooms
            yield name, album
            if before is not None:
                yield f"{_FOREIGN}_{name}", album.elsewhere(before)
            before = album if name == "homes" else before
    if before is not None and "album" in houses:
        yield f"{_FOREIGN}_house", houses["album"].elsewhere(before)


def _solved(bundle: Bundle, named: tuple[str, RoomAlbum]) -> tuple[str, dict[Combination, _Result]]:
    """Return an album by combination; its photographs are compared once for each temperature."""
    source, album = named
    encoder = PhotographEncoder(bundle, threads=1)
    found = dict[Combination, _Result]()
    for temperature in _TEMPERATURES:
        memory = AlbumMemory()
        for misread, (pairs, crowding) in product(_MISREAD, _PAIRS_CROWDING):
            weights = Combination(temperature=temperature, misread=misread, pairs=pairs, crowding=crowding)
            encoder.manifest = weights.changed(bundle.manifest)
            solved = album.solve(encoder, memory)
            pins = [
                (1.0, pin.confidence, solved.misread, (pin.pose.plan_id, pin.pose.room_id) == room)
                for pin, room in zip(solved.pins, album.rooms, strict=True)
                if pin.pose is not None
            ]
            found[weights] = pin_figures(solved.pins, album.rooms), pins
    return source, found


def _fitted_confidence(albums: Mapping[str, list[_Result]]) -> list[float]:
    """Return `AlbumWeights.confidence` by logistic regression, in which sources count alike."""
    rows, weights = [], []
    for source, each in albums.items():
        pins = [pin for _, of_album in each for pin in of_album]
        rows += pins
        weights += [(_OTHERS if source.startswith(_FOREIGN) else 1.0) / max(len(pins), 1)] * len(pins)
    table, weight = np.array(rows), np.array(weights) / sum(weights)
    features = np.stack([table[:, 0], log_odds(table[:, 1]), table[:, 2]], axis=1)
    sign = np.where(table[:, 3] > 0.0, -1.0, 1.0)

    def loss(factors: np.ndarray) -> float:
        return float(weight @ np.logaddexp(0.0, sign * (features @ factors)) + _RIDGE * np.square(factors).sum())

    return optimize.minimize(loss, np.array([0.0, 1.0, 0.0]), method="L-BFGS-B").x.tolist()


def _total(albums: list[Figures]) -> Figures:
    """Return the sums of the counts of albums, and the mean of the rest."""
    total = {name: sum(each[name] for each in albums) for name in albums[0]}
    return total | {"mean_log_probability": float(np.mean([each["mean_log_probability"] for each in albums]))}


def _best(rows: Rows, sources: list[str]) -> Combination:
    def score(weights: Combination) -> float:
        return float(np.mean([rows[weights][source]["mean_log_probability"] for source in sources]))

    return max(rows, key=score)


def _row(weights: Combination, figures: Mapping[str, Figures]) -> dict[str, Any]:
    return {**asdict(weights), "figures": figures}
