"""Write the generated tables of README.md and docs/: `python -m scripts.write_docs`.

A table stands between `<!-- begin: NAME -->` and `<!-- end: NAME -->`, where NAME is a key of `TABLES`. The tests fail
when a table is out of date.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

from scripts.figures import evidence_table, figures_table, paper_tables, training_table
from service.settings import settings_table

ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("lalaloc_core", "service", "lalaloc_client", "examples", "scripts", "benchmarks")
# Purpose and first file of the folders without a package docstring.
_OTHER_FOLDERS = {
    "web": ("The web pages, in TypeScript; `make web` builds `service/web/` of them.", "src/app.ts"),
    "models/default": ("The model that ships, with its card.", "README.md"),
    "docker": ("Image, compose files, nginx, Kubernetes, Grafana dashboard.", "compose.yaml"),
    "tests": (
        "Tests, in folders named as what they test: `core/`, `plans/` (plan files), `service/`, `client/`, `web/`.",
        "test_boundaries.py",
    ),
}
_PART = re.compile(r"<!-- begin: (.+?) -->\n.*?<!-- end: \1 -->", re.DOTALL)


def main() -> None:
    """Bring every document up to date."""
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


def documents() -> dict[Path, str]:
    """Return the up-to-date text of every document that has generated tables."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    return {path: _PART.sub(_filled, text) for path, text in texts.items() if _PART.search(text)}


def _filled(part: re.Match[str]) -> str:
    return f"<!-- begin: {part[1]} -->\n{TABLES[part[1]]()}\n<!-- end: {part[1]} -->"


def folder_map() -> str:
    """Return a Markdown table of all packages, with summary and first file from their docstrings, and other folders.

    Raises:
        FileNotFoundError: the first file of a folder does not exist.
    """
    rows = ["| folder | purpose | begin with |", "|---|---|---|"]
    for package in _PACKAGES:
        for path in sorted((ROOT / package).rglob("__init__.py"), key=lambda path: path.parent):
            docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            summary = " ".join(docstring.split("\n\n")[0].split()).replace("|", "\\|")
            begin = re.search(r"Begin\s+with\s+`([^`]+)`", docstring)
            rows.append(f"| `{path.parent.relative_to(ROOT)}/` | {summary} | {f'`{begin[1]}`' if begin else ''} |")
    for folder, (purpose, first) in _OTHER_FOLDERS.items():
        if not (ROOT / folder / first).exists():
            raise FileNotFoundError(f"'{folder}/{first}' does not exist; correct _OTHER_FOLDERS")
        rows.append(f"| `{folder}/` | {purpose} | `{first}` |")
    return "\n".join(rows)


TABLES: dict[str, Callable[[], str]] = {
    "settings": settings_table,
    "folders": folder_map,
    "figures": figures_table,
    "evidence": evidence_table,
    "paper": paper_tables,
    "training": training_table,
}


if __name__ == "__main__":
    main()
