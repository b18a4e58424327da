"""The wheel: complete, and enough to run the service in an empty environment."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from lalaloc_core import __version__
from tests.test_packaging import PYPROJECT
from tests.test_supply_chain import RELEASE

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel of a copy, because setuptools writes beside the sources."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("lalaloc_core", "lalaloc_client", "service", "models", "examples", "benchmarks"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", out, source]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


@pytest.mark.slow
def test_wheel_has_model_example_and_page(wheel: Path) -> None:
    assert wheel.name == f"lalaloc-{__version__}-py3-none-any.whl"
    names = set(zipfile.ZipFile(wheel).namelist())
    installed = f"lalaloc-{__version__}.data/data/share/lalaloc/models/default"
    assert {f"{installed}/{path.name}" for path in (ROOT / "models" / "default").iterdir()} <= names
    assert {f"service/web/{name}" for name in ("index.html", "example-flat.json")} <= names
    assert "lalaloc_client/py.typed" in names
    assert not [name for name in names if name.startswith(("tests/", "scripts/", "examples/", "benchmarks/"))]


def test_wheel_is_checked_on_every_supported_python() -> None:
    matrix = yaml.safe_load(RELEASE.read_text(encoding="utf-8"))["jobs"]["wheel"]["strategy"]["matrix"]["python"]
    (least,) = re.findall(r'^requires-python = ">=([\d.]+)"$', PYPROJECT, re.MULTILINE)
    assert matrix == re.findall(r'"Programming Language :: Python :: (3\.\d+)"', PYPROJECT)
    assert matrix[0] == least


@pytest.mark.slow
def test_wheel_alone_serves_the_example(wheel: Path) -> None:
    command = [sys.executable, ROOT / "scripts" / "check_wheel.py", wheel]
    done = subprocess.run(command, cwd=wheel.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
