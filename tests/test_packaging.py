"""Tests of installation and image: named files exist, and the right torch is chosen."""

from __future__ import annotations

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts import install_torch
from service.settings import PREFIX, SETTING_NAMES, Settings

ROOT = Path(__file__).parents[1]
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
REPLICAS = yaml.safe_load((ROOT / "docker" / "compose.replicas.yaml").read_text(encoding="utf-8"))["services"]
COMPOSE = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))["services"]["service"]
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
SETTINGS = {PREFIX + name.upper() for name in SETTING_NAMES}


def _constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pins}


def _copied() -> list[str]:
    """Return the sources of the image that come from the repository."""
    copies = re.findall(r"^COPY (?!--from)(.+) \S+$", DOCKERFILE, re.MULTILINE)
    return [source for copy in copies for source in copy.split()]


def test_direct_requirements_are_pinned() -> None:
    project = tomllib.loads(PYPROJECT)["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    requirements = [Requirement(text) for group in groups for text in group]
    pins = _constraints()
    own = {"lalaloc", "torch"}
    for requirement in requirements:
        name = canonicalize_name(requirement.name)
        assert name in own or requirement.specifier.contains(pins[name]), requirement


def test_torch_is_pinned_once() -> None:
    assert "torch" not in _constraints()
    assert re.fullmatch(r"\d+\.\d+\.\d+", install_torch.pinned_version(PYPROJECT))


@pytest.mark.parametrize(
    ("gpu", "found", "expected"),
    [
        (False, {"2.0.0+cpu"}, ["torch==2.0.0+cpu"]),
        (False, {"2.0.0"}, ["torch==2.0.0+cpu", "torch==2.0.0"]),
        (True, {"2.0.0"}, ["torch==2.0.0"]),
    ],
)
def test_cpu_build_is_tried_first_without_a_gpu(
    monkeypatch: pytest.MonkeyPatch, gpu: bool, found: set[str], expected: list[str]
) -> None:
    tried = []

    def pip_install(requirement: str) -> int:
        tried.append(requirement)
        return 0 if requirement.removeprefix("torch==") in found else 1

    monkeypatch.setattr(install_torch.sys, "platform", "linux")
    monkeypatch.setattr(install_torch, "has_gpu", lambda: gpu)
    monkeypatch.setattr(install_torch, "is_installed", lambda version, wants_cpu: False)
    monkeypatch.setattr(install_torch, "pinned_version", lambda pyproject: "2.0.0")
    monkeypatch.setattr(install_torch, "pip_install", pip_install)
    assert install_torch.main() == 0
    assert tried == expected


@pytest.mark.parametrize(
    ("installed", "wants_cpu", "right"),
    [
        ("2.0.0+cpu", True, True),
        ("2.0.0", True, True),
        ("2.0.0+cpu", False, False),
        ("2.0.0", False, True),
        ("1.9.0", True, False),
    ],
)
def test_right_installed_torch_is_kept(
    monkeypatch: pytest.MonkeyPatch, installed: str, wants_cpu: bool, right: bool
) -> None:
    monkeypatch.setattr(install_torch.importlib.metadata, "version", lambda name: installed)
    assert install_torch.is_installed("2.0.0", wants_cpu=wants_cpu) is right


def test_image_copies_existing_files() -> None:
    sources = _copied()
    assert sources
    assert [source for source in sources if not (ROOT / source).exists()] == []
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    let_through = [line[1:] for line in lines if line.startswith("!")]
    assert "*" in lines
    assert [source for source in sources if not any(fnmatch(source.rstrip("/"), name) for name in let_through)] == []


def test_image_and_compose_use_known_settings() -> None:
    named = set(re.findall(r"\bLALALOC_[A-Z_]+", DOCKERFILE)) | set(COMPOSE["environment"])
    assert named <= SETTINGS
    (port,) = re.findall(r"^EXPOSE (\d+)$", DOCKERFILE, re.MULTILINE)
    assert f'"--port", "{port}"' in DOCKERFILE
    assert f"http://127.0.0.1:{port}/readyz" in DOCKERFILE
    assert [published.split(":")[-1] for published in COMPOSE["ports"]] == [port]


def test_compose_publishes_locally_by_default() -> None:
    environment, (published,) = COMPOSE["environment"], COMPOSE["ports"]
    assert published == f"{environment['LALALOC_PUBLISHED_ON'].removesuffix(':8000}')}:8000}}:8000"
    assert environment["LALALOC_PUBLISHED_ON"].startswith("${LALALOC_PUBLISH:-127.0.0.1:")
    assert environment["LALALOC_ALLOW_ANONYMOUS"] == "${LALALOC_ALLOW_ANONYMOUS:-off}"


def test_image_can_export_spans() -> None:
    (extras,) = re.findall(r'pip install .* "\.\[(.*)\]"', DOCKERFILE)
    assert {"service", "lpo", "otel"} <= set(extras.split(","))


def test_proxy_and_replicas_match() -> None:
    replicas = {name: service for name, service in REPLICAS.items() if name.startswith("replica-")}
    proxy = (ROOT / "docker" / "nginx.conf").read_text(encoding="utf-8")
    (port,) = re.findall(r"^EXPOSE (\d+)$", DOCKERFILE, re.MULTILINE)
    assert set(re.findall(r"^ *server (\S+):(\d+)", proxy, re.MULTILINE)) == {(name, port) for name in replicas}
    (listens,) = re.findall(r"listen (\d+);", proxy)
    assert [published.split(":")[-1] for published in REPLICAS["proxy"]["ports"]] == [listens]
    for service in replicas.values():
        assert {name for name in service["environment"] if name.startswith("LALALOC_")} <= SETTINGS
        assert service["build"] == COMPOSE["build"]
        assert service["environment"]["LALALOC_API_KEYS"] == "on"


def test_containers_have_time_to_stop() -> None:
    for service in (COMPOSE, REPLICAS["replica-1"]):
        assert float(service["stop_grace_period"].rstrip("s")) > Settings().requests.stop_deadline_s


def test_image_does_not_run_as_root() -> None:
    final_stage = DOCKERFILE[DOCKERFILE.rindex("\nFROM ") :]
    assert re.search(r"^USER (?!root)\w+$", final_stage, re.MULTILINE)
    build = COMPOSE["build"]
    context = ROOT / "docker" / build["context"]
    assert (context / build["dockerfile"]).read_text(encoding="utf-8") == DOCKERFILE
    assert f"AS {build['target']}\n" in final_stage
