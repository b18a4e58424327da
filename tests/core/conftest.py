"""Fixtures of the core's tests: the tiny bundle, opened, the shipped manifest, and the material library."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lalaloc_core.bundle import Bundle, Manifest
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.nets.layout_network import RingLayoutEncoder
from tests.core.questions import PaintedSession
from tests.core.shipped import bundle


@pytest.fixture(autouse=True)
def _fixed_weights() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def opened_bundle(tiny_bundle: Path) -> Bundle:
    """Tiny bundle with parsed manifest."""
    return Bundle.open(tiny_bundle)


@pytest.fixture(scope="session")
def encoders(opened_bundle: Bundle) -> PhotographEncoder:
    """Tiny bundle on onnxruntime."""
    return PhotographEncoder(opened_bundle, threads=1)


@pytest.fixture(scope="session")
def optimiser(opened_bundle: Bundle) -> PoseRefiner:
    """LPO with the tiny bundle."""
    return PoseRefiner.from_bundle(opened_bundle)


@pytest.fixture(scope="session")
def manifest() -> Manifest:
    """Manifest of the shipped model."""
    return bundle().manifest


@pytest.fixture(scope="session")
def materials() -> MaterialLibrary:
    return MaterialLibrary.create(np.random.default_rng(0))


@pytest.fixture(scope="session")
def perfect(opened_bundle: Bundle, optimiser: PoseRefiner) -> PhotographEncoder:
    """PhotographEncoder whose image encoder reads the wall profile from painted pixels."""
    encoders = PhotographEncoder(opened_bundle, threads=1)
    assert isinstance(optimiser.encoder, RingLayoutEncoder)
    encoders.spheres.session = PaintedSession(optimiser.encoder)
    return encoders
