"""Locks, licences and the release workflow agree with what is installed and published."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts import write_notice
from scripts.write_locks import LOCKS, blocks, extras_of
from tests.test_packaging import PYPROJECT, check_schema, pinned_versions

ROOT = Path(__file__).parents[1]
RELEASE = ROOT / ".github" / "workflows" / "release.yaml"
WORKFLOW: dict[str, Any] = yaml.safe_load(RELEASE.read_text(encoding="utf-8"))
STEPS: list[dict[str, Any]] = [step for job in WORKFLOW["jobs"].values() for step in job["steps"]]
# Packages of other platforms, which no environment on Linux can list in constraints.txt.
ELSEWHERE = {"colorama", "pywin32"}


def _locked(lock: str) -> dict[str, str]:
    """Return the versions of a lock; every requirement has digests."""
    found = blocks((ROOT / lock).read_text(encoding="utf-8"))
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}\b", block) for block in found.values())
    return {canonicalize_name(name): re.split(r"[ \\]", block.split("==")[1])[0] for name, block in found.items()}


def _required_by(extras: list[str]) -> set[str]:
    """Return the names that pyproject.toml requires for some extras."""
    project = tomllib.loads(PYPROJECT)["project"]
    groups: dict[str, list[str]] = project["optional-dependencies"]
    found, left = set(), [*project["dependencies"], *(text for extra in extras for text in groups[extra])]
    while left:
        requirement = Requirement(left.pop())
        if requirement.name == project["name"]:
            left += [text for extra in requirement.extras for text in groups[extra]]
        else:
            found.add(canonicalize_name(requirement.name))
    return found


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_has_the_versions_of_the_constraints(lock: str) -> None:
    pins, locked = pinned_versions(), _locked(lock)
    assert {name: version for name, version in locked.items() if name not in ELSEWHERE} == {
        name: pins[name] for name in locked if name not in ELSEWHERE
    }, "run `make lock`"
    assert "torch" not in locked
    # Everything that the extras require by name is in the lock.
    assert _required_by(extras_of(lock)) - {"torch"} <= locked.keys(), "run `make lock`"


def test_locks_of_image_and_serving_are_parts_of_the_environment() -> None:
    everything, serving, image = (_locked(lock) for lock in LOCKS)
    assert (serving.keys() | image.keys()) <= everything.keys()
    # What installs the packages, and builds this one; none of what only training and tests need.
    assert {"setuptools", "uv"} <= serving.keys()
    assert not serving.keys() & {"sympy", "matplotlib", "onnx", "pytest", "ray", "sphinx", "ifcopenshell"}


def test_torch_lock_is_for_the_pinned_version() -> None:
    text = (ROOT / "torch.lock").read_text(encoding="utf-8")
    (version,) = re.findall(r'"torch==([\d.]+)"', PYPROJECT)
    assert f"CPU builds of torch {version} for Linux" in text
    digests = re.findall(r"^--hash=sha256:([0-9a-f]{64})  # cp\d+ \w+$", text, re.MULTILINE)
    assert len(set(digests)) == len(digests) == text.count("--hash")


def test_notice_lists_the_licences_of_all_that_ships() -> None:
    assert write_notice.notice_text() == write_notice.NOTICE.read_text(encoding="utf-8"), "run `make notice`"
    assert write_notice.licence_of("fastapi") == "MIT"
    assert write_notice.licence_of("no-such-package") is None


def test_release_workflow_is_valid() -> None:
    check_schema("vendor.github-workflows", RELEASE)
    uses = [step["uses"] for step in STEPS if "uses" in step]
    # A tag of an action can be moved, a commit cannot.
    assert [action for action in uses if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action)] == []
    # Rights are given job by job.
    assert WORKFLOW["permissions"] == {}
    assert all("timeout-minutes" in job and "permissions" in job for job in WORKFLOW["jobs"].values())
    # A variable in a script would be code: `${{ }}` only in inputs and environment.
    assert [step["name"] for step in STEPS if "${{" in step.get("run", "")] == []
    text = RELEASE.read_text(encoding="utf-8")
    for part in ("cyclonedx", "cosign sign", "attest-build-provenance", "trivy-action", "make audit", "make digests"):
        assert part in text


def test_digests_are_written_or_nothing_is(tmp_path: Path) -> None:
    """Run `make digests` with a registry that answers for all images, then for the first only."""
    images = ROOT / "docker" / "images.env"
    (tmp_path / "docker").mkdir()
    copy = tmp_path / "docker" / "images.env"
    copy.write_text(images.read_text(encoding="utf-8"), encoding="utf-8")
    docker = tmp_path / "bin" / "docker"
    docker.parent.mkdir()
    environment = os.environ | {"PATH": f"{docker.parent}:{os.environ['PATH']}"}
    for script, status in (("echo sha256:12", 0), ('case "$4" in python*) echo sha256:34;; *) exit 1;; esac', 2)):
        docker.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        docker.chmod(0o755)
        command = ["make", "--no-print-directory", "-f", ROOT / "Makefile", "digests"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr
        lines = copy.read_text(encoding="utf-8").splitlines()
        pinned = [line for line in lines if not line.startswith("#")]
        assert all(line.endswith("@sha256:12") for line in pinned)
        assert [line.partition("@")[0] for line in lines] == [
            line.partition("@sha256")[0] for line in images.read_text(encoding="utf-8").splitlines()
        ]
    assert [path.name for path in copy.parent.iterdir()] == ["images.env"]
