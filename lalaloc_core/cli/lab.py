"""`lalaloc lab`: commands that train, measure and export models, each with a configuration.

A configuration is a dataclass, whose annotations say what its fields mean. Its values come from a TOML or JSON file,
from words such as `preset=trunk`, and from options, which are made of its fields; later ones win.
"""

from __future__ import annotations

import argparse
import inspect
import json
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from lalaloc_core.errors import ConfigError

_FILES = (".toml", ".json")


@dataclass(frozen=True)
class Command:
    """Command: the class of its configuration, the function that runs it, and the key of words without one."""

    kind: type[Any]
    run: Callable[[Any], None]
    positional: str


Textures = Annotated[Path | None, "folder of material pictures for generated homes (default: procedural materials)"]
BundleFolder = Annotated[Path, "model bundle (default: the shipped one)"]
Workers = Annotated[int | None, "worker processes (default: one per core)"]
SkipBad = Annotated[bool, "skip unusable files and samples, and list them"]
Seed = Annotated[int, "random seed of generated homes"]


def summary(command: Command) -> str:
    """Return what a command does."""
    text = inspect.getdoc(command.kind) or ""
    return text[0].lower() + text[1:].rstrip(".")


def add_options(parser: argparse.ArgumentParser, command: Command) -> None:
    """Add the words of a command, and an option for each field of its configuration."""
    parser.add_argument(
        "words",
        nargs="*",
        metavar="WORD",
        help="file of the configuration, .toml or .json; values by the names of the options; and the value of "
        f"--{command.positional.rstrip('_')}",
    )
    hints = get_type_hints(command.kind, include_extras=True)
    for entry in fields(command.kind):
        key, hint, usual = entry.name.rstrip("_"), hints[entry.name], entry.default
        # argparse reads % in help as a format.
        meaning = hint.__metadata__[0].replace("%", "%%")
        given: dict[str, Any] = {"action": "append", "metavar": key.upper()}
        if hint.__origin__ is bool:
            given = {"action": "append_const", "const": "true"}
        elif isinstance(usual, str | int | float | Path):
            meaning += f" (default: {usual})"
        parser.add_argument(f"--{key.replace('_', '-')}", dest=entry.name, help=meaning, **given)
    parser.set_defaults(run=lambda arguments: command.run(configured(command, arguments.words, vars(arguments))))


def configured(command: Command, words: list[str], options: dict[str, list[str] | None]) -> Any:
    """Return a configuration of files, words and options."""
    from lalaloc_core.configuration import build_config

    known = get_type_hints(command.kind)
    raw: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals and Path(word).suffix in _FILES:
            raw |= {_field_name(name, known): value for name, value in _read(Path(word)).items()}
        elif equals:
            _set(raw, known, _field_name(key, known), text)
        else:
            _set(raw, known, command.positional, word)
    for name, texts in options.items():
        for text in (texts or []) if name in known else []:
            _set(raw, known, name, text)
    return build_config(command.kind, raw, path="the configuration")


def _field_name(key: str, known: Mapping[str, Any]) -> str:
    name = key.replace("-", "_")
    if name not in known and f"{name}_" not in known:
        raise ConfigError(f"the configuration has no key '{key}'; it has {', '.join(known).replace('_,', ',')}")
    return name if name in known else f"{name}_"


def _set(raw: dict[str, Any], known: Mapping[str, Any], name: str, text: str) -> None:
    """Set a value by its text; tables and lists get one more."""
    kind = get_origin(known[name]) or known[name]
    types = get_args(known[name]) or (kind,)
    if kind is dict:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--{name.rstrip('_')} is '{text}'; it must be KEY=VALUE")
        raw[name] = raw.get(name, {}) | {key: value if types == (str, str) else _json(value)}
    elif kind is tuple:
        value = _json(text) if text.startswith("[") or float in types else text
        raw[name] = [*raw.get(name, []), *(value if isinstance(value, list) else [value])]
    else:
        raw[name] = _json(text) if {bool, int, float} & set(types) else text


def _json(text: str) -> Any:
    # JSON knows neither .75 nor +1.
    for read in (json.loads, int, float):
        with suppress(ValueError):
            return read(text)
    return text


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise ConfigError(f"'{path}' cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"'{path}' is no {path.suffix[1:].upper()}: {error}") from error


def check_range(configuration: Any, least: int, *names: str) -> None:
    """Check that values are at least `least`, or greater if it is 0 and they are no integers."""
    for name in names:
        value = getattr(configuration, name)
        if value is not None and (value < least or (isinstance(value, float) and value <= least)):
            limit = "positive" if isinstance(value, float) else f"at least {least:g}"
            raise ConfigError(f"{name} is {value:g}; it must be {limit}")
