"""Write the generated parts of docs/: `python -m scripts.write_docs`.

A table stands between `<!-- begin: NAME -->` and `<!-- end: NAME -->`, where NAME is a key of `TABLES`. The tests fail
when a table is out of date. `measured_tables.md.j2` has the tables of docs/bench.json.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.harness import table_head, table_row
from benchmarks.neighbours import markdown as markdown_of_neighbours
from lalaloc_core.cli import entry_point
from lalaloc_core.conditions import CONDITIONS, parts_of
from lalaloc_core.evaluate.reproduce.paper_tables import TABLES as PAPER_TABLES
from lalaloc_core.evaluate.reproduce.paper_tables import TableResult, markdown
from service.cli import entry_point as service_cli
from service.errors import HTTP_PROBLEMS, PROBLEMS
from service.openapi import openapi_text
from service.settings import settings_table

ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("lalaloc_core", "service", "lalaloc_client", "examples", "scripts", "benchmarks")
# Purpose and first file of the folders without a package docstring.
_OTHER_FOLDERS = {
    "clients/typescript": ("Client for browsers and Node in TypeScript, which the web pages use.", "src/index.ts"),
    "web": ("Web pages in TypeScript; `make web` builds `service/web/` from them.", "src/app.ts"),
    "models/default": ("The shipped model and its card.", "README.md"),
    "models/training": ("Recipes of training, and a table of runs.", "README.md"),
    "datasets/heldout": ("Sixty out-of-distribution homes with 240 spheres, for reporting only.", "README.md"),
    "docker": ("Image, compose files, nginx, Kubernetes manifests, Grafana dashboard.", "compose.yaml"),
    "tests": (
        "Tests, one folder per subject: `core/`, `importers/`, `service/`, `client/`, `web/`.",
        "test_boundaries.py",
    ),
}
_MEASURED = ("accuracy", "terms", "views", "films", "annotated_films", "localisability", "uninformative", "speed")
_PART = re.compile(r"<!-- begin: (.+?) -->\n.*?<!-- end: \1 -->", re.DOTALL)


def main() -> None:
    """Bring every document up to date."""
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


def documents() -> dict[Path, str]:
    """Return the up-to-date text of every document that has generated tables."""
    paths = sorted((ROOT / "docs").rglob("*.md"))
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    return {path: _PART.sub(_fill, text) for path, text in texts.items() if _PART.search(text)}


def _fill(part: re.Match[str]) -> str:
    return f"<!-- begin: {part[1]} -->\n{TABLES[part[1]]()}\n<!-- end: {part[1]} -->"


def table(head: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the names of its columns are separated by " | "."""
    return "\n".join([table_head(*head.split(" | ")), *(table_row(*cells) for cells in rows)])


def _read(path: str) -> Any:
    return json.loads((ROOT / path).read_text(encoding="utf-8"))


def measured_table(name: str) -> str:
    """Return a table of docs/bench.json as Markdown: a block of the template."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.get_template("measured_tables.md.j2")
    files = _read("models/default/manifest.json")["files"]
    context = template.new_context(
        {
            "bench": _read("docs/bench.json"),
            "conditions": {name: parts_of(name) for name in CONDITIONS},
            "bundle_mb": sum(entry["bytes"] for entry in files.values()) / 1e6,
        }
    )
    # Blocks see the macros of the template once it has been rendered.
    "".join(template.root_render_func(context))
    lines = "".join(template.blocks[name](context)).splitlines()
    return "\n".join(line for line in lines if line)


def neighbours_table() -> str:
    """Return the latency of one tenant beside another as a Markdown table, with the command that measured it."""
    if not (ROOT / "docs/neighbours.json").exists():
        return "Not measured with this version."
    report = _read("docs/neighbours.json")
    return f"`{report['command']}` on {report['cores']} cores:\n\n{markdown_of_neighbours(report)}"


def pairs_table() -> str:
    """Return durations of each release, and over those of an old one (processor times in brackets), as Markdown."""
    releases = {name: found for name, found in _read("docs/pairs.json").items() if "figures" in found}

    def cell(name: str, found: dict[str, Any]) -> str:
        unit = "" if "over" in name else " s"
        ratio = "" if found["ratio"] is None else f": {found['ratio']:.2f}"
        cpu = "" if found["cpu_ratio"] is None else f" ({found['cpu_ratio']:.2f})"
        return f"{found['after']:.3g}{unit}{ratio}{cpu}"

    names = dict.fromkeys(name for found in releases.values() for name in found["figures"])
    head = " | ".join(["figure", *(f"{name} over {found['before']}" for name, found in releases.items())])
    each = [found["figures"] for found in releases.values()]
    return table(head, [(name, *(cell(name, row[name]) if name in row else "–" for row in each)) for name in names])


def paper_tables() -> str:
    """Return the measured tables of the paper with our figures beside the paper's, as Markdown."""
    paths = [ROOT / "docs" / "tables" / f"{paper_table.name}.json" for paper_table in PAPER_TABLES]
    return "\n".join(markdown(TableResult.read(path)) for path in paths if path.exists()).rstrip()


def folder_map() -> str:
    """Return a Markdown table of all packages, with summary and first file from their docstrings, and other folders."""
    rows = []
    for package in _PACKAGES:
        for path in sorted((ROOT / package).rglob("__init__.py"), key=lambda path: path.parent):
            docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            summary = " ".join(docstring.split("\n\n")[0].split()).replace("|", "\\|")
            begin = re.search(r"Begin\s+with\s+`([^`]+)`", docstring)
            rows.append((f"`{path.parent.relative_to(ROOT)}/`", summary, f"`{begin[1]}`" if begin else ""))
    for folder, (purpose, first) in _OTHER_FOLDERS.items():
        if not (ROOT / folder / first).exists():
            raise FileNotFoundError(f"'{folder}/{first}' does not exist; correct _OTHER_FOLDERS")
        rows.append((f"`{folder}/`", purpose, f"`{first}`"))
    return table("folder | purpose | begin with", rows)


def metrics_table() -> str:
    """Return the service's metrics as a Markdown table, from the calls that create them."""
    kinds = {"counter": "counter", "gauge": "gauge", "_gauge": "gauge", "_histogram": "histogram"}
    kinds |= {"tenant_counter": "counter", "tenant_gauge": "gauge"}
    metrics = {}
    for path in sorted((ROOT / "service").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or len(node.args) < 2:
                continue
            kind = kinds.get(getattr(node.func, "attr", getattr(node.func, "id", "")))
            name, meaning = (
                argument.value if isinstance(argument, ast.Constant) else None for argument in node.args[:2]
            )
            if kind and isinstance(name, str) and isinstance(meaning, str) and name.startswith("lalaloc_"):
                metrics[f"{name}_total" if kind == "counter" else name] = (kind, meaning)
    return table("metric | type | meaning", [(f"`{name}`", *row) for name, row in sorted(metrics.items())])


def routes_table() -> str:
    """Return the routes of the HTTP API as a Markdown table."""
    paths = yaml.safe_load(openapi_text())["paths"]
    rows = [
        (f"`{method.upper()} {route}`", operation["summary"])
        for route, operations in paths.items()
        for method, operation in operations.items()
    ]
    return table("route | purpose", rows)


def problems_table() -> str:
    """Return the problem kinds of the HTTP API as a Markdown table."""
    kinds = {kind.slug: kind for kind in (*PROBLEMS.values(), *HTTP_PROBLEMS.values())}
    ordered = sorted(kinds.values(), key=lambda kind: (kind.status, kind.slug))
    return table("kind | status | title", [(f"`{kind.slug}`", f"{kind.status}", kind.title) for kind in ordered])


def commands() -> str:
    """Return every command with its options, as Markdown sections."""
    parsers = [*_leaves(entry_point.build_parser()), *_leaves(service_cli.build_parser())]
    return "\n\n".join(_section(parser) for parser in parsers)


def _leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parsers of commands that have no commands of their own."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield parser
    for group in groups:
        for command in group.choices.values():
            yield from _leaves(command)


def _section(parser: argparse.ArgumentParser) -> str:
    rows = []
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction | argparse._VersionAction):
            continue
        name = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        choices = f"; one of {', '.join(map(str, action.choices))}" if action.choices else ""
        meaning = (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%").replace("|", "\\|")
        rows.append((f"`{name}`", f"{meaning}{choices}"))
    options = table("option | meaning", rows) if rows else "No options."
    return "\n".join([f"## {parser.prog}", "", *([parser.description, ""] if parser.description else []), options])


TABLES: dict[str, Callable[[], str]] = {
    "settings": settings_table,
    "folders": folder_map,
    "metrics": metrics_table,
    "routes": routes_table,
    "problems": problems_table,
    "cli": commands,
    "neighbours": neighbours_table,
    "pairs": pairs_table,
    "paper": paper_tables,
    **{name: partial(measured_table, name) for name in _MEASURED},
}


if __name__ == "__main__":
    main()
