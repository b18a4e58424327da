"""Table of errors and problems: complete and consistent."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from string import Formatter

import service
from lalaloc_core.errors import LaLaLocError
from service import errors
from service.errors import PROBLEMS, ServiceError, problem_kind


def _all_subclasses(cls: type[Exception]) -> set[type[Exception]]:
    return {cls} | {found for child in cls.__subclasses__() for found in _all_subclasses(child)}


def _own_errors() -> list[type[Exception]]:
    owners = ("lalaloc_core.errors", "service.")
    own = [error for error in _all_subclasses(LaLaLocError) if error.__module__.startswith(owners)]
    return sorted(own, key=lambda error: error.__name__)


def test_every_error_has_a_table_entry() -> None:
    assert [error for error in _own_errors() if error not in PROBLEMS] == []


def test_equal_types_have_equal_titles_and_only_internal_errors_are_500_and_hidden() -> None:
    meanings = {kind.type: (kind.title, kind.status) for kind in PROBLEMS.values()}
    assert all(meanings[kind.type] == (kind.title, kind.status) for kind in PROBLEMS.values())
    assert all(kind.public == (kind.status != 500) for kind in PROBLEMS.values())


def test_subclass_without_entry_uses_its_base() -> None:
    class Later(ServiceError):
        pass

    assert problem_kind(Later("later")) is PROBLEMS[ServiceError]
    assert problem_kind(RuntimeError()).status == 500


def _raised() -> Iterator[tuple[str, str, int]]:
    """Yield where the service makes an error by the base's constructor, its name, and the number of its values."""
    for path in sorted(Path(service.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            # An error is raised, with or without a call, or returned by a call.
            if not isinstance(node, ast.Call | ast.Raise):
                continue
            made = node.func if isinstance(node, ast.Call) else node.exc
            name = made.attr if isinstance(made, ast.Attribute) else getattr(made, "id", "")
            error = getattr(errors, name, None)
            if isinstance(error, type) and issubclass(error, ServiceError) and error.__init__ is ServiceError.__init__:
                yield f"{path.name}:{node.lineno}", name, len(node.args) if isinstance(node, ast.Call) else 0


def test_errors_get_as_many_values_as_their_messages_have_places() -> None:
    raised = list(_raised())
    assert len({name for _, name, _ in raised}) > 40
    for where, name, count in raised:
        message = getattr(errors, name).message
        places = [place for _, place, *_ in Formatter().parse(message) if place not in (None, "retry_after_s")]
        assert count == len({place or str(index) for index, place in enumerate(places)}), f"{where}: {name}"
