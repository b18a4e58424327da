"""Table of errors and problems: complete and consistent."""

from __future__ import annotations

import pytest

from lalaloc_core.errors import LaLaLocError
from service.errors import ServiceError
from service.problem_kinds import PROBLEMS, problem_kind


def _all_subclasses(cls: type[Exception]) -> set[type[Exception]]:
    return {cls} | {found for child in cls.__subclasses__() for found in _all_subclasses(child)}


def _own_errors() -> list[type[Exception]]:
    owners = ("lalaloc_core.errors", "service.")
    return sorted(
        (error for error in _all_subclasses(LaLaLocError) if error.__module__.startswith(owners)),
        key=lambda e: e.__name__,
    )


@pytest.mark.parametrize("error", _own_errors(), ids=lambda error: error.__name__)
def test_every_error_has_a_table_entry(error: type[Exception]) -> None:
    assert error in PROBLEMS


def test_equal_types_have_equal_titles_and_statuses() -> None:
    meanings = {kind.type: (kind.title, kind.status) for kind in PROBLEMS.values()}
    assert all(meanings[kind.type] == (kind.title, kind.status) for kind in PROBLEMS.values())


def test_only_internal_errors_are_500_and_hidden() -> None:
    assert all(kind.public == (kind.status != 500) for kind in PROBLEMS.values())


def test_subclass_without_entry_uses_its_base() -> None:
    class Later(ServiceError):
        pass

    assert problem_kind(Later()) is PROBLEMS[ServiceError]
    assert problem_kind(RuntimeError()).status == 500
