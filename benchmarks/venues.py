"""Which of very many plans: how fast the index of prototypes answers, and how often it finds what brute force finds.

Generated homes stand in for real ones, with variants of each where more plans are asked for: drawn out along each axis
by up to a tenth, with other ceilings, turned by quarters and mirrored by chance. Their prototypes come from the
renderer, without latents; those of variants are made of these, which is exact but for what lies between two azimuths.
Queries are photographs of some of the homes, encoded by the model.

Brute force compares all prototypes under all hypotheses, where `--exact` allows for so many pairs: it takes half a
minute for every 100 million. Where it does not, all of them are compared by codes, and the best million as they are.
Times are of the processor, in one thread.

    .venv/bin/python -m benchmarks.venues --plans 2000 --queries 20 --exact 1e9
    .venv/bin/python -m benchmarks.venues --plans 2500 --repeat 40 --queries 12 --exact 0
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, renderer_cache_of
from lalaloc_core.learn.synth.homes.splits import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.venue.plan_index import COMPARED, SCANNED, PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, packed_openings, prototypes_of, unpacked_openings
from scripts.make_prototype_cells import grid_without_latents
from service.query.prototype_file import BlockKey, PrototypeFile

_TEST = SPLIT_NUMBERS["test"]
_FIRST = 20
# Variants of plans are longer and wider by at most so much.
_DRAWN_OUT = 0.1
# Pairs that are compared as they are where brute force compares all by codes.
_MAX_COMPARED = 1_000_000
_STEP_M = 0.5


def prototypes(plans: int, seed: int) -> list[np.ndarray]:
    """Prototypes of so many homes, sorted into cells."""
    blocks = []
    for number in range(plans):
        home, _ = home_of(_TEST, seed, number)
        rows = prototypes_of(grid_without_latents(home), home.plan).rows
        rows["cell"] = shipped_cells().sort(rows)
        blocks.append(rows)
        if number % 1000 == 999:
            print(f"  {number + 1} homes", flush=True)
    return blocks


def repeated(blocks: list[np.ndarray], times: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Each of some plans several times: as it is, and variants of it."""
    found = list(blocks)
    for number in range(1, times):
        variants = [_variant(block, rng) for block in blocks]
        # Together, which is faster.
        cell = shipped_cells().sort(np.concatenate(variants))
        ends = np.cumsum([len(block) for block in variants])
        for block, own in zip(variants, np.split(cell, ends[:-1]), strict=True):
            block["cell"] = own
        found += variants
        if number % 5 == 4:
            print(f"  {len(found)} plans", flush=True)
    return found


def _variant(block: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Prototypes of a plan that was drawn out along both axes, turned by quarters and mirrored by chance."""
    rows, (x, y) = block.copy(), 1.0 + rng.uniform(-_DRAWN_OUT, _DRAWN_OUT, 2)
    azimuth = 2.0 * np.pi / AZIMUTHS * np.arange(AZIMUTHS)
    # What is seen at an azimuth was seen at another one before, at another distance.
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
    """A photograph of each home, asked about with what is known of the camera."""
    encoders, renderers = Encoders(bundle, threads=1), renderer_cache_of(_TEST, seed, None)
    size = bundle.manifest.image_height, bundle.manifest.image_width
    for number in homes:
        home, rng = home_of(_TEST, seed, number)
        shot = sample_shots(home, 1, rng, "full")[0]
        image = RenderedPhotograph(shot, renderers).image(*size)
        known, unknown = CameraHeight(shot.camera_height_m), CameraHeight(1.5, float("inf"))
        yield number, "heading known", encoders.query(image, shot.heading, known)
        yield number, "heading unknown", encoders.query(image, None, known)
        yield number, "heading and height unknown", encoders.query(image, None, unknown)


def _best(mass: np.ndarray) -> np.ndarray:
    return np.argsort(-mass, kind="stable")


def main() -> None:
    """Print times and recall."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--plans", type=int, default=2000)
    parser.add_argument(
        "--repeat", type=int, default=1, help="so many variants of each plan, whose homes are generated once"
    )
    parser.add_argument("--queries", type=int, default=20)
    parser.add_argument("--compared", type=int, default=COMPARED, help="pairs that the index compares as they are")
    parser.add_argument(
        "--scanned", type=float, nargs="+", default=[SCANNED], help="pairs that the index compares by codes"
    )
    parser.add_argument("--exact", type=float, default=1e9, help="most pairs that brute force compares for a query")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    bundle, rng = Bundle.open(asked.bundle), np.random.default_rng(asked.seed)
    blocks = repeated(prototypes(asked.plans, asked.seed), asked.repeat, rng)
    count = np.array([len(block) for block in blocks])
    print(f"{len(blocks)} plans, {count.sum()} prototypes of {blocks[0].itemsize} bytes")
    weights, config, told = bundle.manifest.evidence, MatchingConfig(), defaultdict(lambda: defaultdict(list))
    with tempfile.TemporaryDirectory() as folder:
        path, cells = Path(folder) / "prototypes.bin", shipped_cells()
        keys = [BlockKey(number, "0" * 64) for number in range(len(blocks))]
        begin = time.process_time()
        file = PrototypeFile(path, cells_version=cells.version, limit_bytes=2**40)
        file.add(dict(zip(keys, blocks, strict=True)))
        written = time.process_time()
        file.close()
        file = PrototypeFile(path, cells_version=cells.version, limit_bytes=2**40)
        opened = time.process_time()
        found = file.find(keys)
        first = np.array([found[key][0] for key in keys])
        index = PlanIndex.of(file.rows(), first, count, step_m=_STEP_M, cells=cells)
        built = time.process_time()
        index.prepare()
        print(
            f"written in {written - begin:.2f} s, opened in {opened - written:.2f} s, index in {built - opened:.2f} s, "
            f"its codes in {time.process_time() - built:.2f} s, {index.nbytes / 1e6:.0f} MB",
            flush=True,
        )
        homes = np.linspace(0, asked.plans - 1, asked.queries).astype(int).tolist()
        for number, name, query in queries(bundle, homes, asked.seed):
            pairs = int(count.sum()) * min(len(query.roll), AZIMUTHS) * len(query.camera_height.offsets)
            how = "brute force" if pairs <= asked.exact else "all codes"
            compared = 10**15 if pairs <= asked.exact else _MAX_COMPARED
            brute = _best(index.log_masses(query, weights, config, compared=compared, scanned=10**15))
            for scanned in asked.scanned:
                begin, began = time.process_time(), time.perf_counter()
                mass = index.log_masses(query, weights, config, compared=asked.compared, scanned=int(scanned))
                tally = told[f"{name}, {scanned:,.0f} pairs by codes"]
                tally["ms"].append(1e3 * (time.process_time() - begin))
                tally["ms by the clock"].append(1e3 * (time.perf_counter() - began))
                best = _best(mass)
                tally["right plan in the first 20"].append(number in best[:_FIRST])
                tally["right plan in the first 128"].append(number in best[:128])
                tally[f"{how}: recall of 20"].append(len(np.intersect1d(best[:_FIRST], brute[:_FIRST])) / _FIRST)
                tally[f"{how}: its first in the first 20"].append(brute[0] in best[:_FIRST])
                tally[f"{how}: right plan in the first 20"].append(number in brute[:_FIRST])
        file.close()
    for name, tally in told.items():
        print(f"{name}, n = {asked.queries}")
        for what, values in tally.items():
            if what.startswith("ms"):
                print(f"  {what}: p50 {np.median(values):.0f}, p95 {np.percentile(values, 95):.0f}")
            else:
                print(f"  {what}: {np.mean(values):.1%} of {len(values)}")


if __name__ == "__main__":
    main()
