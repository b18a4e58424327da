"""Options that several commands have, and types of option values with range checks."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from lalaloc_core.files import default_bundle

_Number = TypeVar("_Number", int, float)


def _within(
    name: str, kind: Callable[[str], _Number], limits: str, holds: Callable[[_Number], bool]
) -> Callable[[str], _Number]:
    """Return the type of numbers for which `holds`; argparse's errors have its `name`."""

    def parse(text: str) -> _Number:
        value = kind(text)
        if not holds(value):
            raise argparse.ArgumentTypeError(f"{text} is out of range; it must be {limits}")
        return value

    parse.__name__ = name
    return parse


positive = _within("positive", float, "positive", lambda value: 0.0 < value < math.inf)
heading = _within("heading", float, "between -360 and 360 degrees", lambda value: -360.0 <= value <= 360.0)
tolerance = _within("tolerance", float, "between 0 and 45 degrees", lambda value: 0.0 <= value <= 45.0)

_OPTIONS: dict[str, dict[str, Any]] = {
    "--bundle": {"type": Path, "help": "model bundle (default: the shipped one)"},
    "--camera-height": {
        "type": positive,
        "metavar": "M",
        "help": "metres above the floor (default: the plan's, otherwise estimated)",
    },
}


def add_options(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add shared options by name, such as "--bundle"."""
    for name in names:
        # The path of the shipped model depends on the working folder.
        default: dict[str, Any] = {"default": default_bundle()} if name == "--bundle" else {}
        parser.add_argument(name, **_OPTIONS[name], **default)
