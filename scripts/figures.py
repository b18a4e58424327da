"""Tables of the documentation from measured figures; `measured_tables.md.j2` has those of docs/bench.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.neighbours import markdown as markdown_of_neighbours
from lalaloc_core.conditions import CONDITIONS, parts_of
from lalaloc_core.evaluate.reproduce.paper_tables import TABLES, TableResult, markdown

ROOT = Path(__file__).resolve().parent.parent
BENCH = ROOT / "docs" / "bench.json"
NEIGHBOURS = ROOT / "docs" / "neighbours.json"
PAPER_TABLES = ROOT / "docs" / "tables"
MANIFEST = ROOT / "models" / "default" / "manifest.json"


def measured_table(name: str) -> str:
    """Return a table of docs/bench.json as Markdown: a block of the template."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.get_template("measured_tables.md.j2")
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    context = template.new_context(
        {
            "bench": json.loads(BENCH.read_text(encoding="utf-8")),
            "conditions": {name: parts_of(name) for name in CONDITIONS},
            "bundle_mb": sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6,
        }
    )
    # Blocks see the macros of the template once it has been rendered.
    "".join(template.root_render_func(context))
    lines = "".join(template.blocks[name](context)).splitlines()
    return "\n".join(line for line in lines if line)


def neighbours_table() -> str:
    """Return the latency of one tenant beside another as a Markdown table, with the command that measured it."""
    if not NEIGHBOURS.exists():
        return "Not measured with this version."
    report = json.loads(NEIGHBOURS.read_text(encoding="utf-8"))
    return f"`{report['command']}` on {report['cores']} cores:\n\n{markdown_of_neighbours(report)}"


def paper_tables() -> str:
    """Return the measured tables of the paper with our figures beside the paper's, as Markdown."""
    paths = [PAPER_TABLES / f"{table.name}.json" for table in TABLES]
    return "\n".join(markdown(TableResult.read(path)) for path in paths if path.exists()).rstrip()


def table(head: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the names of its columns are separated by " | "."""
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([f"| {head} |", f"|{'---|' * len(head.split(' | '))}", *lines])
