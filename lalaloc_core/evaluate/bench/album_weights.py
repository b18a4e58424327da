"""Weights of the evidence in albums, measured together on albums of pictures by others and of generated homes.

The temperature of walls and openings, the weight of recognised objects, the share of misread photographs, and that of
pairs replace each other in part, so all combinations are tried. The sources are a furnished house, annotated and
path-traced rooms, generated homes with and without furniture, and the house's photographs among others and in a foreign
plan; they count alike, whatever the number of their albums. The score is the mean log probability of the right room.
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

from lalaloc_core.bundle import Bundle, Manifest
from lalaloc_core.evaluate.bench.albums import galleries, home_album
from lalaloc_core.evaluate.bench.house import house_albums
from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.runs.albums import RoomAlbum
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder

# Most albums of a source.
_MOST = 16
_TEMPERATURES = (1.0, 0.5, 0.25, 0.125)
_OBJECTS = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (4.0, 2.0))
_MISREAD, _PAIRS = (0.05, 0.2, 0.4), (0.25, 0.12, 0.06)


@dataclass(frozen=True, kw_only=True)
class Combination:
    """Factor of the bundle's temperature of views, and fields of `ObjectsManifest` and of `AlbumWeights`."""

    temperature: float
    weight: float
    recognition: float
    misread: float
    pairs: float

    def changed(self, manifest: Manifest) -> Manifest:
        """Return a manifest with these weights."""
        view, objects = manifest.view, manifest.objects
        if view is not None:
            before = manifest.evidence_for(view=True)
            view = replace(view, evidence=replace(before, temperature=self.temperature * before.temperature))
        if objects is not None:
            objects = replace(objects, weight=self.weight, recognition=self.recognition)
        album = replace(manifest.album, misread=self.misread, pairs=self.pairs)
        return replace(manifest, view=view, objects=objects, album=album)


Figures = dict[str, float]
Rows = Mapping[Combination, Mapping[str, Figures]]


def bench_album_weights(setting: Setting) -> dict[str, Any]:
    """Measure all combinations of weights.

    Returns:
        `rows`, the figures of every combination by source; `chosen`, the one with the best score; and `left_out`, by
        source the one with the best score of the other sources.
    """
    figures: defaultdict[Combination, defaultdict[str, list[Figures]]] = defaultdict(lambda: defaultdict(list))
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for source, found in pool.map(partial(_pinned, setting.bundle), _albums(setting)):
            for weights, row in found.items():
                figures[weights][source].append(row)
    rows = {weights: {source: _total(each) for source, each in row.items()} for weights, row in figures.items()}
    sources = sorted({source for row in rows.values() for source in row})
    return {
        "chosen": _best(rows, sources),
        "left_out": {source: _best(rows, [each for each in sources if each != source]) for source in sources},
        "rows": [_row(weights, row) for weights, row in rows.items()],
    }


def _albums(setting: Setting) -> Iterator[tuple[str, RoomAlbum]]:
    for name, album in house_albums(setting).items():
        yield ("house" if None not in album.rooms else name), album
    homes = range(min(setting.homes, _MOST))
    cases = {
        **galleries(setting),
        "homes": (home_album(setting, home, split="validation") for home in homes),
        "empty_homes": (home_album(setting, home, split="validation", furniture="empty") for home in homes),
    }
    for name, each in cases.items():
        for case in islice(each, _MOST):
            yield name, case.with_rooms


def _pinned(bundle: Bundle, named: tuple[str, RoomAlbum]) -> tuple[str, dict[Combination, Figures]]:
    """Return the figures of an album by combination; its photographs are compared once for each temperature."""
    source, album = named
    encoder = PhotographEncoder(bundle, threads=1)
    found = dict[Combination, Figures]()
    for temperature in _TEMPERATURES:
        memory = AlbumMemory()
        for (weight, recognition), misread, pairs in product(_OBJECTS, _MISREAD, _PAIRS):
            weights = Combination(
                temperature=temperature, weight=weight, recognition=recognition, misread=misread, pairs=pairs
            )
            encoder.manifest = weights.changed(bundle.manifest)
            found[weights] = album.figures(encoder, memory)
    return source, found


def _total(albums: list[Figures]) -> Figures:
    """Return the sums of the counts of albums, and the mean of the rest."""
    total = {name: sum(each[name] for each in albums) for name in albums[0]}
    return total | {"mean_log_probability": float(np.mean([each["mean_log_probability"] for each in albums]))}


def _best(rows: Rows, sources: list[str]) -> dict[str, Any]:
    def score(weights: Combination) -> float:
        return float(np.mean([rows[weights][source]["mean_log_probability"] for source in sources]))

    best = max(rows, key=score)
    return _row(best, rows[best])


def _row(weights: Combination, figures: Mapping[str, Figures]) -> dict[str, Any]:
    return {**asdict(weights), "figures": figures}
