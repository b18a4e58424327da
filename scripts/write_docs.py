"""Write the generated parts of the documentation: `python -m scripts.write_docs`.

They stand between `<!-- begin: NAME -->` and `<!-- end: NAME -->`; a stale one fails the tests.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from scripts.figures import (
    IDEAS,
    SIZES,
    evidence_table,
    figures_table,
    paper_tables,
    training_table,
    variants_table,
)
from service.settings import PREFIX, Settings

ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("lalaloc_core", "service", "lalaloc_client", "examples", "scripts", "benchmarks")
# Folders without a docstring: what each is for, and what to begin with.
_OTHER_FOLDERS = {
    "web": ("The web pages, in TypeScript; `make web` builds `service/web/` of them.", "src/app.ts"),
    "models/default": ("The model that ships, with its card.", "README.md"),
    "docker": ("Image, compose files, nginx, Kubernetes, Grafana dashboard.", "compose.yaml"),
    "tests": (
        "Tests, in folders named as what they test: `core/`, `plans/` (plan files), `service/`, `client/`, `web/`.",
        "test_boundaries.py",
    ),
}


def main() -> None:
    """Bring every document up to date."""
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


def documents() -> dict[Path, str]:
    """Every document that has generated parts, as it should read."""
    parts = {
        ROOT / "README.md": {"figures": figures_table()},
        ROOT / "docs" / "operations.md": {"settings": settings_table()},
        ROOT / "docs" / "results.md": {
            "figures": figures_table(),
            "evidence": evidence_table(),
            "paper": paper_tables(),
            "training": training_table(),
            "sizes": variants_table(SIZES),
            "ideas": variants_table(IDEAS),
        },
        ROOT / "docs" / "architecture.md": {"folders": folder_map()},
    }
    return {path: _filled(path.read_text(encoding="utf-8"), contents) for path, contents in parts.items()}


def settings_table() -> str:
    """The service's settings as a Markdown table."""
    rows = ["| variable | default | meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = field.default
        if isinstance(default, Path) and default.is_absolute():
            default = default.relative_to(ROOT)
        shown = "" if default is None else f"`{default}`"
        rows.append(f"| `{PREFIX}{name.upper()}` | {shown} | {field.description} |")
    return "\n".join(rows)


def folder_map() -> str:
    """Every package, what its docstring says it is for and where to begin, as a Markdown table; then other folders.

    Raises:
        FileNotFoundError: what one of those others is to be begun with is gone.
    """
    rows = ["| folder | what it is for | begin with |", "|---|---|---|"]
    for package in _PACKAGES:
        for path in sorted((ROOT / package).rglob("__init__.py"), key=lambda path: path.parent):
            docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            summary = " ".join(docstring.split("\n\n")[0].split()).replace("|", "\\|")
            begin = re.search(r"Begin\s+with\s+`([^`]+)`", docstring)
            rows.append(f"| `{path.parent.relative_to(ROOT)}/` | {summary} | {f'`{begin[1]}`' if begin else ''} |")
    for folder, (purpose, first) in _OTHER_FOLDERS.items():
        if not (ROOT / folder / first).exists():
            raise FileNotFoundError(f"the map of folders names '{folder}/{first}', which is gone")
        rows.append(f"| `{folder}/` | {purpose} | `{first}` |")
    return "\n".join(rows)


def _filled(text: str, contents: dict[str, str]) -> str:
    """The text with each named part replaced.

    Raises:
        ValueError: a part has no place in the text, or a place no part.
    """
    places = list(_places(text))
    if sorted(places) != sorted(contents):
        raise ValueError(f"the document has places for {places}, the generated parts are {list(contents)}")
    for name, content in contents.items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n{content}\n{end}{rest.partition(end)[2]}"
    return text


def _places(text: str) -> Iterator[str]:
    for match in re.finditer(r"<!-- begin: (.+?) -->", text):
        yield match[1]


if __name__ == "__main__":
    main()
