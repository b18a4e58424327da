"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

# Derandomised, without a time limit per example: results depend on the commit only.
settings.register_profile(
    "tests",
    deadline=None,
    derandomize=True,
    max_examples=50,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("tests")


@pytest.fixture(scope="session")
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train both stages of the `tiny` preset for seconds and export the bundle."""
    from lalaloc_core.learn.export.run import export_run
    from lalaloc_core.learn.training.data import TrainingData
    from lalaloc_core.learn.training.presets import PRESETS
    from lalaloc_core.learn.training.run import train_image, train_layout

    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("tiny")
    device = torch.device("cpu")
    # Rendering the usual number of validation panoramas would take longer than the training.
    data = TrainingData(validation_scenes=2)
    train_layout(PRESETS["tiny"], folder, device=device, data=data, workers=0)
    train_image(PRESETS["tiny"], folder, device=device, data=data, workers=0)
    return export_run(folder, folder / "bundle", name="tiny", version="test").folder
