"""Reconstruction of photographs from their features: how much of a picture a decoder recovers.

    python -m benchmarks.features --homes 300 --out features.png

A decoder learns from generated homes to draw a panorama of 64 x 32 pixels from features, and draws the photographs of
other homes. Each column of the picture is predicted from the features of the sectors around it by ridge regression on
random Fourier features, an approximation of kernel ridge regression. The share of variance that it explains, beyond
each row's mean over all photographs, is printed for brightness and for colour, with all features and with the shape of
the room alone (all outputs other than the ring): the difference is what the ring adds.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from benchmarks.harness import argument_parser
from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.learn.data.dataset import Split
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.encode.sphere_encoder import SphereEncoder

_ROWS = 32
# Sectors on each side of a column whose features the decoder sees.
_NEIGHBOURS = 4
_FOURIER = 2000
# Median distance of two samples is divided by this to give the width of the kernel.
_SHARPER = 1.0
_PENALTIES = (1e-3, 1e-2, 1e-1)
# Levels of a pixel, and brightness and two differences of colours from red, green and blue.
_OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [0.5, -0.5, 0.0], [0.25, 0.25, -0.5]])
_SHOTS = 3


def photographs(
    bundle: Bundle, split: Split, homes: int, seed: int
) -> tuple[Float[np.ndarray, "n s f"], Float[np.ndarray, "n s r 3"], int]:
    """Return features by sector, with the channels of the ring first, small pictures by column, and ring channels."""
    network, renderers = SphereEncoder(bundle, threads=1), split_renderer_cache(SPLIT_NUMBERS[split], seed, None)
    size = bundle.manifest.image_height, bundle.manifest.image_width
    features, pictures, channels = [], [], 0
    for number in range(homes):
        home, rng = home_of(SPLIT_NUMBERS[split], seed, number)
        for shot in sample_shots(home, _SHOTS, rng, "full"):
            image = RenderedPhotograph(shot, renderers).image(*size)
            outputs = network.outputs(image, 1.0)
            ring = outputs["ring"].T
            channels, sectors = ring.shape[1], len(ring)
            columns = [outputs[name].reshape(sectors, -1) for name in ("log_profile", "log_scale", "opening_logits")]
            whole = np.concatenate(
                [np.atleast_1d(outputs[name]) for name in ("log_ceiling", "log_ceiling_scale", "room_type_logits")]
            )
            features.append(np.hstack([ring, *columns, np.tile(whole, (sectors, 1))]))
            small = cv2.resize(image, (sectors, _ROWS), interpolation=cv2.INTER_AREA)
            pictures.append(small.transpose(1, 0, 2).astype(np.float32) / 255.0)
        if number % 50 == 49:
            print(f"  {number + 1} homes", flush=True)
    return np.array(features, np.float32), np.array(pictures), channels


def windows(features: Float[np.ndarray, "n s f"]) -> Float[np.ndarray, "ns w"]:
    """Return the features of each sector and its neighbours."""
    turned = [np.roll(features, shift, axis=1) for shift in range(-_NEIGHBOURS, _NEIGHBOURS + 1)]
    joined = np.concatenate(turned, axis=2)
    return joined.reshape(-1, joined.shape[2])


class Decoder:
    """Ridge regression on random Fourier features beside the features themselves."""

    def __init__(self, inputs: np.ndarray, targets: np.ndarray, rng: np.random.Generator) -> None:
        """Fit; every tenth sample chooses the penalty."""
        self._mean, self._scale = inputs.mean(axis=0), inputs.std(axis=0) + 1e-6
        self._target_mean = targets.mean(axis=0)
        scaled = (inputs - self._mean) / self._scale
        some = rng.integers(len(inputs), size=(2, 2000))
        width = np.median(np.linalg.norm(scaled[some[0]] - scaled[some[1]], axis=1)) / _SHARPER
        self._waves = (rng.normal(size=(inputs.shape[1], _FOURIER)) / width).astype(np.float32)
        self._phases = rng.uniform(0.0, 2.0 * np.pi, _FOURIER).astype(np.float32)
        # Neighbouring samples are of one photograph, so that blocks are held out.
        held = np.arange(len(inputs)) % 640 < 64
        basis, wanted = self._basis(inputs), targets - self._target_mean
        gram, moments = basis[~held].T @ basis[~held], basis[~held].T @ wanted[~held]
        scores = {}
        for penalty in _PENALTIES:
            weights = np.linalg.solve(gram + penalty * len(basis) * np.eye(len(gram), dtype=np.float32), moments)
            scores[penalty] = float(np.square(basis[held] @ weights - wanted[held]).mean()), weights
        self._penalty = min(scores, key=lambda penalty: scores[penalty][0])
        self._weights = scores[self._penalty][1]

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Return the predicted columns."""
        return self._basis(inputs) @ self._weights + self._target_mean

    def _basis(self, inputs: np.ndarray) -> np.ndarray:
        scaled = ((inputs - self._mean) / self._scale).astype(np.float32)
        return np.hstack([scaled, np.sqrt(2.0) * np.cos(scaled @ self._waves + self._phases)])


def explained_shares(found: np.ndarray, pictures: np.ndarray, mean: np.ndarray) -> dict[str, float]:
    """Return the share of variance that is explained, of brightness and of colour."""
    shares = {}
    for name, axes in (("brightness", _OPPONENT[:1]), ("colour", _OPPONENT[1:])):
        errors, spread = ((values @ axes.T) for values in (found - pictures, mean - pictures))
        shares[name] = 1.0 - float(np.square(errors).sum() / np.square(spread).sum())
    return shares


def main() -> None:
    """Fit and test both decoders; print the shares, and write pictures if asked to."""
    parser = argument_parser(__doc__)
    parser.add_argument("--homes", type=int, default=300, help="homes to learn from; a quarter as many are tested")
    parser.add_argument("--out", type=Path, metavar="PICTURE", help="photographs and what was recovered of them")
    parser.add_argument("--bundle", type=Path, default=default_bundle(), help="model bundle (default: the shipped one)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the homes (default: %(default)s)")
    options = parser.parse_args()
    bundle = Bundle.open(options.bundle)
    features, pictures, channels = photographs(bundle, "train", options.homes, options.seed)
    tested, truth, _ = photographs(bundle, "test", max(options.homes // 4, 1), options.seed)
    mean = pictures.mean(axis=(0, 1))
    drawn = {}
    for name, first in (("shape of the room", channels), ("all features", 0)):
        rng = np.random.default_rng(options.seed)
        decoder = Decoder(windows(features[..., first:]), pictures.reshape(-1, _ROWS * 3), rng)
        drawn[name] = decoder(windows(tested[..., first:])).reshape(truth.shape)
        shares = explained_shares(drawn[name], truth, mean)
        print(f"{name}: " + ", ".join(f"{share:.1%} of the variance of {what}" for what, share in shares.items()))
    if options.out is not None:
        shown = range(0, len(truth), len(truth) // 4 + 1)
        rows = [np.hstack([_picture(each[index]) for each in (truth, *drawn.values())]) for index in shown]
        Image.fromarray(np.vstack(rows)).save(options.out)


def _picture(columns: np.ndarray) -> np.ndarray:
    """Return a picture by column as pixels, four times as large."""
    pixels = np.round(255.0 * columns.clip(0.0, 1.0)).astype(np.uint8).transpose(1, 0, 2)
    return np.pad(pixels.repeat(4, axis=0).repeat(4, axis=1), ((2, 2), (2, 2), (0, 0)), constant_values=255)


if __name__ == "__main__":
    main()
