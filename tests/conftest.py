"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
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
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Train both stages of the `tiny` preset for seconds and export the bundle, once for all processes of a run."""
    folder = tmp_path_factory.mktemp("tiny")
    if worker_id == "master":
        return _tiny_bundle(folder)
    shared = tmp_path_factory.getbasetemp().parent / "tiny"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            _tiny_bundle(folder)
            folder.rename(shared)
    return shared / "bundle"


def _tiny_bundle(folder: Path) -> Path:
    from lalaloc_core.learn.export.run_export import export_run
    from lalaloc_core.learn.training.presets import PRESETS
    from lalaloc_core.learn.training.run import train_stage
    from lalaloc_core.learn.training.training_data import TrainingData

    torch.set_num_threads(1)
    device = torch.device("cpu")
    # Rendering the usual number of validation panoramas would take longer than the training.
    data = TrainingData(validation_scenes=2)
    train_stage("layout", PRESETS["tiny"], folder, device=device, data=data, workers=0)
    train_stage("image", PRESETS["tiny"], folder, device=device, data=data, workers=0)
    return export_run(folder, folder / "bundle", name="tiny", version="test").folder


@pytest.fixture(scope="session")
def tiny_view_bundle(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the tiny bundle with an encoder of views, whose weights are random, and the measured errors of another."""
    import dataclasses

    from lalaloc_core.bundle import Bundle, default_bundle, write_manifest
    from lalaloc_core.learn.export.bundle_export import add_view_encoder
    from lalaloc_core.learn.training.presets import PRESETS
    from lalaloc_core.nets.view_network import ViewNetwork

    origin = Bundle.open(tiny_bundle)
    folder = tmp_path_factory.mktemp("tiny-views")
    for name in origin.manifest.files:
        (folder / name).write_bytes(origin.read(name))
    config = PRESETS["tiny"]
    torch.manual_seed(0)
    encoder = ViewNetwork(config.view, config.ring)
    bundle = add_view_encoder(dataclasses.replace(origin, folder=folder), config, encoder, {})
    measured = Bundle.open(default_bundle()).manifest
    assert bundle.manifest.view is not None
    assert measured.view is not None
    view = dataclasses.replace(bundle.manifest.view, errors=measured.view.errors)
    priors = {"opening_prior": measured.opening_prior, "errors": measured.errors}
    return write_manifest(folder, dataclasses.replace(bundle.manifest, view=view, **priors)).folder
