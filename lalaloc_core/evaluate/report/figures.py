"""Style and formats of charts: drawn once by matplotlib, inlined in the page and saved as pictures."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# Colours of charts by the page's CSS variable; the page has a second set for dark mode.
INK, MUTED, RULE, PAPER = "#1c2128", "#59626d", "#d5dbe1", "#ffffff"
SERIES = ("#0b63b5", "#c2410c", "#0f7b53", "#a3297a", "#8a6d00", "#0e7c86", "#6d4ed1", "#7a4a2a")
COLOURS = {
    "ink": INK,
    "muted": MUTED,
    "rule": RULE,
    "paper": PAPER,
    **{f"series-{number}": colour for number, colour in enumerate(SERIES, start=1)},
}
_DASHES = ("-", "--", ":", "-.")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "lalaloc",
    # Names of runs can contain dollar signs.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 0.7,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": "auto",
    "legend.frameon": False,
}
_PNG_DPI = 160


@dataclass(frozen=True, eq=False, kw_only=True)
class Chart:
    """Drawn chart.

    `name` is that of its files, `title` and `description` are for screen readers, and `svg` is on white.
    """

    name: str
    title: str
    description: str
    figure: Figure
    svg: str

    def png(self) -> bytes:
        """Return the chart as PNG, on white."""
        content = io.BytesIO()
        with chart_style():
            self.figure.savefig(content, format="png", dpi=_PNG_DPI)
        return content.getvalue()

    def inline(self) -> str:
        """Return the SVG for an HTML page that defines the variables of `COLOURS`; text is escaped."""
        root = ElementTree.fromstring(self.svg)
        _without_namespaces(root)
        for parent in list(root.iter()):
            for child in [child for child in parent if child.tag in ("style", "metadata")]:
                parent.remove(child)
        _rename_identifiers(root, self.name)
        names = {colour: name for name, colour in COLOURS.items()}
        for element in root.iter():
            style = element.get("style", "")
            for colour, name in names.items():
                style = style.replace(colour, f"var(--{name})")
            if style:
                element.set("style", style)
        for size in ("width", "height"):
            del root.attrib[size]
        root.set("role", "img")
        root.set("aria-labelledby", f"{self.name}-title {self.name}-description")
        for place, (tag, text) in enumerate((("title", self.title), ("desc", self.description))):
            label = ElementTree.Element(tag, id=f"{self.name}-{'title' if tag == 'title' else 'description'}")
            label.text = text
            root.insert(place, label)
        return ElementTree.tostring(root, encoding="unicode")


@contextmanager
def chart_style() -> Iterator[None]:
    """Apply the style of charts; draw and `finish` them inside."""
    with mpl.rc_context(_STYLE):
        yield


def finish(figure: Figure, *, name: str, title: str, description: str) -> Chart:
    """Return a figure as a chart."""
    svg = io.StringIO()
    # Without a date, equal runs give equal reports.
    figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return Chart(name=name, title=title, description=description, figure=figure, svg=svg.getvalue())


def line_styles(count: int) -> list[dict[str, Any]]:
    """Return colour and dash of each line; the first 32 differ."""
    return [
        {"color": SERIES[index % len(SERIES)], "linestyle": _DASHES[index // len(SERIES) % len(_DASHES)]}
        for index in range(count)
    ]


def bar_colours(names: Sequence[str]) -> dict[str, str]:
    """Return one colour per name."""
    return dict(zip(names, islice(cycle(SERIES), len(names)), strict=True))


def _without_namespaces(root: ElementTree.Element) -> None:
    """Remove namespaces, which inline SVG in HTML does not have."""
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = {name.rpartition("}")[2]: value for name, value in element.attrib.items()}


def _rename_identifiers(root: ElementTree.Element, prefix: str) -> None:
    """Prefix referenced identifiers with the chart's name and remove others: a page has several charts."""
    references = {
        value[1:] if value.startswith("#") else value[5:-1]
        for element in root.iter()
        for value in element.attrib.values()
        if value.startswith(("#", "url(#"))
    }
    for element in root.iter():
        for name, value in list(element.attrib.items()):
            if name == "id" and value not in references:
                del element.attrib[name]
            elif name == "id":
                element.set(name, f"{prefix}-{value}")
            elif value.startswith("#") and value[1:] in references:
                element.set(name, f"#{prefix}-{value[1:]}")
            elif value.startswith("url(#"):
                element.set(name, f"url(#{prefix}-{value[5:]}")
