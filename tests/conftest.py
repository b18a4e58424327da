"""Fixtures shared by all tests."""

from __future__ import annotations

import dataclasses
import fcntl
import os
import tempfile
from pathlib import Path

import certifi
import pytest
from hypothesis import HealthCheck, settings

from lalaloc_core.bundle import Bundle, default_bundle, write_manifest
from tests import tiny

# Derandomised, without a time limit per example: results depend on the commit only.
_UNCHECKED = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
settings.register_profile(
    "tests", deadline=None, derandomize=True, max_examples=50, database=None, suppress_health_check=_UNCHECKED
)
settings.load_profile("tests")

# Tests talk to this machine only, and reading all certificate authorities takes every client a tenth of a second.
_AUTHORITY = tempfile.NamedTemporaryFile(suffix=".pem")  # noqa: SIM115, it lives as long as the process.
_AUTHORITY.write(certifi.contents().partition("\n\n# ")[0].encode())
_AUTHORITY.flush()
os.environ["SSL_CERT_FILE"] = _AUTHORITY.name


@pytest.fixture(scope="session")
def tiny_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the committed bundle of the `tiny` preset."""
    return tiny.unpack(tmp_path_factory.mktemp("bundle"))


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Train both stages of the `tiny` preset, once for all processes; return the run's folder, with its `bundle`."""
    if worker_id == "master":
        return tiny.train(tmp_path_factory.mktemp("tiny")).parent
    shared = tmp_path_factory.getbasetemp().parent / "tiny"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            tiny.train(tmp_path_factory.mktemp("tiny")).parent.rename(shared)
    return shared


@pytest.fixture(scope="session")
def tiny_view_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the tiny bundle with an encoder of views, whose weights are random, and the measured errors of another."""
    folder = tiny.unpack(tmp_path_factory.mktemp("views"), views=True)
    bundle, measured = Bundle.open(folder), Bundle.open(default_bundle()).manifest
    assert bundle.manifest.view is not None
    assert measured.view is not None
    view = dataclasses.replace(bundle.manifest.view, errors=measured.view.errors)
    priors = {"opening_prior": measured.opening_prior, "errors": measured.errors}
    return write_manifest(folder, dataclasses.replace(bundle.manifest, view=view, **priors)).folder
