"""What is served is what was built from the sources, and small."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
WEB, BUILT = ROOT / "web", ROOT / "service" / "web"
# All that a visitor may load.
MAX_BYTES = 1_500_000


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _sources() -> str:
    """The digest that `web/build.mjs` writes down."""
    paths = [path for path in (WEB / "src").rglob("*") if path.is_file()]
    paths += [WEB / name for name in ("build.mjs", "package.json", "package-lock.json", "tsconfig.json")]
    lines = sorted((path.relative_to(ROOT).as_posix(), _digest(path)) for path in paths)
    return hashlib.sha256("".join(f"{name}\n{digest}\n" for name, digest in lines).encode()).hexdigest()


def test_what_is_served_was_built_from_the_sources_that_are_here() -> None:
    told = json.loads((BUILT / "built.json").read_text(encoding="utf-8"))
    assert told["sources"] == _sources(), "service/web is stale: run `make web`"
    found = {path.name: _digest(path) for path in BUILT.iterdir() if path.name != "built.json"}
    assert told["files"] == found, "service/web is never edited by hand: change web/src, run `make web`"


def test_the_pages_are_small() -> None:
    own = [path for path in BUILT.iterdir() if not path.name.startswith("swagger-ui")]
    assert sum(path.stat().st_size for path in own) < MAX_BYTES


def test_the_example_on_the_page_is_that_of_the_examples() -> None:
    for path in BUILT.glob("example-*"):
        assert path.read_bytes() == (ROOT / "examples" / path.name.removeprefix("example-")).read_bytes()


def test_the_lock_file_names_no_registry() -> None:
    lock = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))
    assert [name for name, package in lock["packages"].items() if "resolved" in package] == []
    assert all("integrity" in package for name, package in lock["packages"].items() if name)


def test_what_is_bundled_is_named_with_its_licence() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    lock = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    for name in json.loads((WEB / "package.json").read_text(encoding="utf-8"))["dependencies"]:
        package = lock[f"node_modules/{name}"]
        assert f"{name} {package['version']}" in notice
        assert package["license"] in ("MIT", "Apache-2.0")


def test_modules_are_small() -> None:
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in (WEB / "src").glob("*.ts")}
    assert {name: length for name, length in lengths.items() if length > 400} == {}
