"""Write the cells of `lalaloc_core.localise.venue.prototype_cells`: k-means over prototypes of generated homes.

The homes are training homes, some of them scaled up, so that offices and halls find cells as well. The service sorts
stored plans again when the cells change.

    .venv/bin/python -m scripts.make_prototype_cells
"""

from __future__ import annotations

import argparse
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.learn.synth.homes.plans import TRAIN, Home, home_of
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.venue.prototype_cells import CELLS_FILE, features, half_norms, nearest
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, prototypes_of, unpacked_openings
from lalaloc_core.render.sampling import pose_grid
from lalaloc_core.render.sweep import profiles_at

_STEP_M, _CAMERA_HEIGHT_M = 0.5, 1.5
# Share of scaled homes, and range of the logarithm of their factor.
_SCALED, _LOG_FACTOR = 0.2, (0.2, 1.4)


def grid_without_latents(home: Home) -> PoseGrid:
    """Return the pose grid of a home with wall profiles and zeros as latents."""
    poses = pose_grid(home.plan, _STEP_M)
    profile_m = profiles_at(
        home.plan, poses.position_m, poses.room_index, np.zeros(len(poses)), 4 * AZIMUTHS, np.float32
    )
    return PoseGrid(poses, np.zeros((len(poses), 1), np.float32), profile_m, _STEP_M, _CAMERA_HEIGHT_M)


def sample(homes: int, seed: int) -> np.ndarray:
    """Return the prototypes of a number of homes."""
    parts, rng = list[np.ndarray](), np.random.default_rng(seed)
    for index in range(homes):
        home, _ = home_of(TRAIN, seed, index)
        part = prototypes_of(grid_without_latents(home), home.plan)
        if rng.random() < _SCALED:
            part["log_profile"] += np.float16(rng.uniform(*_LOG_FACTOR))
        parts.append(part)
    return np.concatenate(parts)


def centres(feature: Float[np.ndarray, "n f"], count: int, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """Return the number of the nearest centre of each row after k-means."""
    centre = feature[rng.choice(len(feature), count, replace=False)]
    chosen = nearest(feature, centre, half_norms(centre))
    for _ in range(rounds):
        members = np.bincount(chosen, minlength=count)
        total = np.zeros_like(centre)
        np.add.at(total, chosen, feature)
        # A centre without members keeps its place.
        centre = np.where(members[:, None] > 0, total / np.maximum(members, 1)[:, None], centre)
        chosen = nearest(feature, centre, half_norms(centre))
    return chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=500)
    parser.add_argument("--cells", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=CELLS_FILE)
    options = parser.parse_args()
    rows = sample(options.homes, options.seed)
    chosen = centres(features(rows), options.cells, options.rounds, np.random.default_rng(options.seed))
    used, chosen = np.unique(chosen, return_inverse=True)
    members = np.bincount(chosen)[:, None]
    log_profile = np.zeros((len(used), AZIMUTHS))
    np.add.at(log_profile, chosen, rows["log_profile"].astype(float))
    share = np.zeros((len(used), AZIMUTHS, len(OPENING_CLASSES)))
    np.add.at(share, chosen, unpacked_openings(rows["openings"])[:, :, None] == np.arange(len(OPENING_CLASSES)))
    mean_profile = (log_profile / members).astype(np.float16)
    mean_share = np.round(255 * share / members[:, None]).astype(np.uint8)
    version = zlib.crc32(mean_profile.tobytes() + mean_share.tobytes())
    np.savez_compressed(options.out, log_profile=mean_profile, share=mean_share, version=version)
    print(f"{len(used)} cells of {len(rows)} prototypes of {options.homes} homes, version {version:08x}: {options.out}")


if __name__ == "__main__":
    main()
