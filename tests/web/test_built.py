"""The served pages are built from the sources, and small."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
WEB, BUILT = ROOT / "web", ROOT / "service" / "web"
# Limit for all pages together, and for the runtime of WebAssembly, which is loaded on demand.
MAX_BYTES, MAX_RUNTIME_BYTES = 1_500_000, 3_500_000


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _sources() -> str:
    """Return the digest of the sources, as in `web/build.mjs`."""
    folders = (WEB / "src", ROOT / "clients" / "typescript" / "src")
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    paths += [WEB / name for name in ("build.mjs", "package.json", "package-lock.json", "tsconfig.json")]
    lines = sorted((path.relative_to(ROOT).as_posix(), _digest(path)) for path in paths)
    return hashlib.sha256("".join(f"{name}\n{digest}\n" for name, digest in lines).encode()).hexdigest()


def test_built_pages_match_the_sources() -> None:
    built = json.loads((BUILT / "built.json").read_text(encoding="utf-8"))
    assert built["sources"] == _sources(), "service/web is stale: run `make web`"
    digests = {path.name: _digest(path) for path in BUILT.iterdir() if path.name != "built.json"}
    assert built["files"] == digests, "service/web was edited by hand: change web/src and run `make web`"


def test_pages_are_small() -> None:
    runtime = [path for path in BUILT.iterdir() if path.name.startswith("onnxruntime.")]
    own = [path for path in BUILT.iterdir() if path not in runtime and not path.name.startswith("swagger-ui")]
    assert sum(path.stat().st_size for path in own) < MAX_BYTES
    assert sum(path.stat().st_size for path in runtime) < MAX_RUNTIME_BYTES


def test_example_files_are_those_of_the_examples() -> None:
    for path in BUILT.glob("example-*"):
        folders = (ROOT / "examples", ROOT / "examples" / "real")
        (example,) = (file for folder in folders for file in folder.glob(path.name.removeprefix("example-")))
        assert path.read_bytes() == example.read_bytes()


def test_lock_file_names_no_registry() -> None:
    lock = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))
    assert [name for name, package in lock["packages"].items() if "resolved" in package] == []
    assert all("integrity" in package for name, package in lock["packages"].items() if name)


def test_notice_names_bundled_packages() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    lock = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    for name in json.loads((WEB / "package.json").read_text(encoding="utf-8"))["dependencies"]:
        package = lock[f"node_modules/{name}"]
        assert f"{name} {package['version']}" in notice
        assert package["license"] in ("MIT", "Apache-2.0")


def test_modules_are_short() -> None:
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in (WEB / "src").glob("*.ts")}
    assert {name: length for name, length in lengths.items() if length > 400} == {}
