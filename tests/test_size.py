"""Size of the code: what a reader has to go through."""

from __future__ import annotations

import subprocess
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Limits of lines and files. They may only be lowered.
LIMITS = {"lines of Python": 95_371, "files of Python": 550, "lines of TypeScript": 10_657, "lines of tests": 48_534}
# The client that blocks is generated from the one that does not.
_GENERATED = "lalaloc_client/blocking/*"
_NOT_SOURCES = {".venv", "build", "data", "runs"}
_INSTALLED = {"node_modules", "dist", "generated"}


def _files() -> list[str]:
    """Return the paths of all sources: those that git knows, or those that a folder without git has."""
    if (ROOT / ".git").exists():
        listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True)
        return [path for path in listed.stdout.splitlines() if (ROOT / path).is_file()]
    folders = [path for path in ROOT.iterdir() if path.is_dir() and path.name not in _NOT_SOURCES]
    found = [path.relative_to(ROOT) for folder in folders for path in folder.rglob("*.*")]
    return [str(path) for path in found if path.suffix in (".py", ".ts") and not _INSTALLED.intersection(path.parts)]


def _sizes() -> dict[str, int]:
    files = _files()
    python = [path for path in files if fnmatch(path, "*.py") and not fnmatch(path, _GENERATED)]
    tests = [path for path in python if path.startswith("tests/")]
    code = [path for path in python if not path.startswith("tests/")]

    def lines(paths: list[str]) -> int:
        return sum((ROOT / path).read_bytes().count(b"\n") for path in paths)

    typescript = [path for path in files if path.endswith(".ts")]
    counted = (lines(code), len(code), lines(typescript), lines(tests))
    return dict(zip(LIMITS, counted, strict=True))


@pytest.mark.parametrize("what", LIMITS)
def test_code_stays_within_its_size(what: str) -> None:
    size = _sizes()[what]
    assert size <= LIMITS[what], f"{size} {what}; the limit is {LIMITS[what]}: simplify or delete, do not raise it"
