"""Options that several commands have, and types of option values with range checks."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from lalaloc_core.errors import InvalidInputError
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

_PATHS = ("PLAN", "PHOTO", "FILM", "FOLDER", "FILE", "PICTURE", "DIR", "YAML")
_OPTION = re.compile(r"^(\S+(?:, \S+)?)(?: ([A-Z][A-Z:]*))?: (.*(?:\n .*)*)", re.MULTILINE)
PLAN = "plan PLAN: a floor plan, in any format of docs/how-to/import-a-plan.md"
TURN = "--turn FILM: film of one slow turn on the spot, or a folder of photographs of one, instead of PHOTO"
CAMERA_HEIGHT = "--camera-height M: metres above the floor (default: the plan's, otherwise estimated)"
BUNDLE = "--bundle DIR: model bundle (default: the shipped one)"


def add_options(parser: argparse.ArgumentParser, text: str, **more: Mapping[str, Any]) -> None:
    """Add options and arguments, each by its names, the metavar, a colon, and the meaning, continued on indented lines.

    The metavar tells the type: paths, metres (M), degrees (DEG), else text. An option without one is a switch. `more`
    has further arguments of `add_argument` by the names of their values.
    """
    for names, metavar, meaning in _OPTION.findall(text):
        kind = Path if metavar in _PATHS else {"M": positive, "DEG": float}.get(metavar, str)
        given = {"type": kind, "metavar": metavar} if metavar else {"action": "store_true"}
        given |= more.get(names.split("--")[-1].replace("-", "_"), {})
        parser.add_argument(*names.split(", "), help=" ".join(meaning.split()), **given)
    if BUNDLE in text:
        # The path of the shipped model depends on the working folder.
        parser.set_defaults(bundle=default_bundle())


def check_sources(arguments: argparse.Namespace) -> None:
    """Refuse a command without photographs and without --turn, and one with both."""
    if not arguments.photographs and arguments.turn is None:
        raise InvalidInputError("no photograph is given: give one or more photographs, or --turn with a film or folder")
    if arguments.photographs and arguments.turn is not None:
        raise InvalidInputError("photographs and --turn exclude each other: leave one of them out")
