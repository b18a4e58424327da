"""Write the cells of `lalaloc_core.localise.venue.prototype_cells`: k-means over prototypes of generated homes.

The homes are those for training. Some of them are scaled up, so that offices and halls find cells as well. Plans that
were sorted into other cells are sorted anew where they are read.

    .venv/bin/python -m scripts.make_prototype_cells
"""

from __future__ import annotations

import argparse
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.learn.synth.homes.plans import Home
from lalaloc_core.learn.synth.homes.splits import TRAIN, home_of
from lalaloc_core.localise.poses import PoseGrid
from lalaloc_core.localise.venue.prototype_cells import CELLS_FILE, features, nearest
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, Prototypes, joined, prototypes_of, unpacked_openings
from lalaloc_core.render.sweep import profiles_at
from lalaloc_core.render.sampling import pose_grid

_STEP_M, _CAMERA_HEIGHT_M = 0.5, 1.5
# The share of homes that are scaled, and the logs of the factors.
_SCALED, _LOG_FACTOR = 0.2, (0.2, 1.4)


def grid_without_latents(home: Home) -> PoseGrid:
    """The grid of a home as the renderer has it, without what an encoder makes of it."""
    poses = pose_grid(home.plan, _STEP_M)
    profile_m = profiles_at(
        home.plan, poses.position_m, poses.room_index, np.zeros(len(poses)), 4 * AZIMUTHS, np.float32
    )
    return PoseGrid(poses, np.zeros((len(poses), 1), np.float32), profile_m, _STEP_M, _CAMERA_HEIGHT_M)


def sample(homes: int, seed: int) -> np.ndarray:
    """Prototypes of so many homes."""
    parts, rng = list[Prototypes](), np.random.default_rng(seed)
    for index in range(homes):
        home, _ = home_of(TRAIN, seed, index)
        part = prototypes_of(grid_without_latents(home), home.plan)
        if rng.random() < _SCALED:
            part.rows["log_profile"] += np.float16(rng.uniform(*_LOG_FACTOR))
        parts.append(part)
    return joined(parts).rows


def centres(feature: Float[np.ndarray, "n f"], count: int, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """k-means: the nearest centre of each in the end."""
    centre = feature[rng.choice(len(feature), count, replace=False)]
    chosen = nearest(feature, centre)
    for _ in range(rounds):
        members = np.bincount(chosen, minlength=count)
        total = np.zeros_like(centre)
        np.add.at(total, chosen, feature)
        # A centre that nothing is nearest to stays where it is.
        centre = np.where(members[:, None] > 0, total / np.maximum(members, 1)[:, None], centre)
        chosen = nearest(feature, centre)
    return chosen


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=500)
    parser.add_argument("--cells", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=CELLS_FILE)
    asked = parser.parse_args()
    rows = sample(asked.homes, asked.seed)
    chosen = centres(features(rows), asked.cells, asked.rounds, np.random.default_rng(asked.seed))
    there, chosen = np.unique(chosen, return_inverse=True)
    members = np.bincount(chosen)[:, None]
    log_profile = np.zeros((len(there), AZIMUTHS))
    np.add.at(log_profile, chosen, rows["log_profile"].astype(float))
    share = np.zeros((len(there), AZIMUTHS, len(OPENING_CLASSES)))
    np.add.at(share, chosen, unpacked_openings(rows["openings"])[:, :, None] == np.arange(len(OPENING_CLASSES)))
    told = (log_profile / members).astype(np.float16), np.round(255 * share / members[:, None]).astype(np.uint8)
    version = zlib.crc32(told[0].tobytes() + told[1].tobytes())
    np.savez_compressed(asked.out, log_profile=told[0], share=told[1], version=version)
    print(f"{len(there)} cells of {len(rows)} prototypes of {asked.homes} homes, version {version:08x}: {asked.out}")


if __name__ == "__main__":
    main()
