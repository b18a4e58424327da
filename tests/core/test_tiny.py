"""The committed tiny bundle, compared with the code that trains it."""

from __future__ import annotations

from pathlib import Path

import pytest
import safetensors.torch
import torch

from lalaloc_core.bundle import IMAGE_WEIGHTS, LAYOUT_WEIGHTS, Bundle
from tests import tiny

_REMEDY = "run `python -m tests.tiny` (30 s) and commit tests/tiny.zip"


def test_tiny_bundle_has_the_configuration_of_the_preset() -> None:
    assert tiny.committed("configuration") == tiny.configuration(), f"the preset `tiny` changed: {_REMEDY}"


@pytest.mark.slow
def test_tiny_bundle_is_the_one_that_the_code_trains(request: pytest.FixtureRequest, tiny_bundle: Path) -> None:
    if tiny.committed("trained_from") == tiny.trained_from():
        return
    trained = Bundle.open(request.getfixturevalue("tiny_run") / "bundle")
    for name in (IMAGE_WEIGHTS, LAYOUT_WEIGHTS):
        kept = safetensors.torch.load(Bundle.open(tiny_bundle).read(name))
        new = safetensors.torch.load(trained.read(name))
        assert kept.keys() == new.keys(), f"the networks changed: {_REMEDY}"
        for key, weights in kept.items():
            # Processors differ in the order of their sums.
            same = torch.allclose(weights.float(), new[key].float(), rtol=0.02, atol=0.02)
            assert same, f"training gives other weights in {name}, {key}: {_REMEDY}"
