"""Recall of the index of prototypes among very many plans, which `city.py` prints.

Generated homes take the place of real ones, and variants of them that of more homes: stretched along both axes, with
other ceilings, turned by quarters and mirrored at random. Their prototypes are computed from those of the home, exactly
up to interpolation between azimuths. Queries are rendered photographs of some homes, encoded by the model.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.venue.index_search import ALIGNED, SearchLimits
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, packed_openings, prototypes_of, unpacked_openings
from scripts.make_prototype_cells import grid_without_latents

_TEST = SPLIT_NUMBERS["test"]
# Variants are longer and wider by at most this share.
_MAX_STRETCH = 0.1
_STEP_M = 0.5
# Homes that `recall` generates at most; further plans are variants of them. Ranks within which it counts right plans.
_HOMES, _RANKS = 2500, (1, 20, 128)


def prototypes(plans: int, seed: int) -> list[np.ndarray]:
    """Return the prototypes of homes, sorted into cells."""
    blocks = []
    for number in range(plans):
        home, _ = home_of(_TEST, seed, number)
        rows = prototypes_of(grid_without_latents(home), home.plan).rows
        rows["cell"] = shipped_cells().assign(rows)
        blocks.append(rows)
        if number % 1000 == 999:
            print(f"  {number + 1} homes", file=sys.stderr, flush=True)
    return blocks


def repeat_with_variants(blocks: list[np.ndarray], times: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return each plan and variants of it."""
    found = list(blocks)
    for number in range(1, times):
        variants = [_variant(block, rng) for block in blocks]
        # One sort of all variants is faster than one per variant.
        cell = shipped_cells().assign(np.concatenate(variants))
        ends = np.cumsum([len(block) for block in variants])
        for block, own in zip(variants, np.split(cell, ends[:-1]), strict=True):
            block["cell"] = own
        found += variants
        if number % 5 == 4:
            print(f"  {len(found)} plans", file=sys.stderr, flush=True)
    return found


def _variant(block: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return prototypes of a plan stretched along both axes, turned by quarters and mirrored at random."""
    rows, (x, y) = block.copy(), 1.0 + rng.uniform(-_MAX_STRETCH, _MAX_STRETCH, 2)
    azimuth = 2.0 * np.pi / AZIMUTHS * np.arange(AZIMUTHS)
    # Stretching moves a point to another azimuth and distance.
    before = np.arctan2(np.sin(azimuth) / y, np.cos(azimuth) / x)
    farther = -0.5 * np.log(np.square(np.cos(azimuth) / x) + np.square(np.sin(azimuth) / y))
    place = before / (2.0 * np.pi) * AZIMUTHS % AZIMUTHS
    lower, share = place.astype(int), place % 1.0
    log_profile = block["log_profile"].astype(np.float32)
    between = (1.0 - share) * log_profile[:, lower % AZIMUTHS] + share * log_profile[:, (lower + 1) % AZIMUTHS]
    order = np.roll(np.arange(AZIMUTHS), rng.integers(4) * AZIMUTHS // 4)
    order = -order % AZIMUTHS if rng.random() < 0.5 else order
    rows["log_profile"] = (between + farther)[:, order]
    kind = unpacked_openings(block["openings"])[:, np.rint(place).astype(int) % AZIMUTHS]
    rows["openings"] = packed_openings(kind[:, order])
    rows["log_area"] += np.log(x * y)
    rows["ceiling_m"] += rng.normal(0.0, 0.1)
    return rows


def queries(bundle: Bundle, homes: list[int], seed: int) -> Iterator[tuple[int, str, Query]]:
    """Yield queries with a photograph of each home: its number, the known values, the query."""
    encoders, renderers = PhotographEncoder(bundle, threads=1), split_renderer_cache(_TEST, seed, None)
    size = bundle.manifest.image_height, bundle.manifest.image_width
    for number in homes:
        home, rng = home_of(_TEST, seed, number)
        shot = sample_shots(home, 1, rng, "full")[0]
        image = RenderedPhotograph(shot, renderers).image(*size)
        known, unknown = CameraHeight(shot.camera_height_m), CameraHeight(1.5, float("inf"))
        yield number, "heading known", encoders.spheres.query(image, shot.heading, known)
        yield number, "heading unknown", encoders.spheres.query(image, None, known)
        yield number, "heading and height unknown", encoders.spheres.query(image, None, unknown)


def recall(bundle: Bundle, plans: int, photographs: int, seed: int = 0) -> dict[str, dict[str, float]]:
    """Return how often the index ranks the right plan among the first ones, with and without alignment, and its time.

    Args:
        bundle: the model.
        plans: number of plans, homes and variants of them.
        photographs: number of photographs, each of another home where there are as many.
        seed: seed of the homes.
    """
    homes = min(plans, _HOMES)
    blocks = repeat_with_variants(prototypes(homes, seed), plans // homes, np.random.default_rng(seed))
    count = np.array([len(block) for block in blocks])
    rows, cells = np.concatenate(blocks), shipped_cells()
    index = PlanIndex.build(rows, np.cumsum(count) - count, count, step_m=_STEP_M, cells=cells)
    index.prepare()
    columns: dict[str, list[tuple[int, float]]] = defaultdict(list)
    photographed = np.linspace(0, homes - 1, photographs).astype(int).tolist()
    for number, name, query in queries(bundle, photographed, seed):
        for aligned, shown in ((0, f"{name}, not aligned"), (ALIGNED, name)):
            begin = time.process_time()
            mass = index.whole.log_masses(
                query, bundle.manifest.evidence, MatchingConfig(), SearchLimits(aligned=aligned)
            )
            seconds = time.process_time() - begin
            columns[shown].append((int((mass > mass[number]).sum()), seconds))
    return {
        name: {
            "plans": len(blocks),
            "n": len(values),
            **{f"right_among_{first}": float(np.mean([rank < first for rank, _ in values])) for first in _RANKS},
            "cpu_ms_p50": round(1e3 * float(np.median([seconds for _, seconds in values])), 1),
        }
        for name, values in columns.items()
    }
