"""`lalaloc-service serve --example`."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.truth import PLAN_PATH
from service.cli.entry_point import store_example
from service.settings import Settings
from service.storage import open_store


@pytest.mark.parametrize("twice", [False, True])
def test_example_is_stored_in_an_empty_database_only(tmp_path: Path, twice: bool) -> None:
    settings = Settings(data_dir=tmp_path)
    store = open_store(settings)
    try:
        assert store_example(store, settings) == "Example flat"
        if twice:
            assert store_example(store, settings) is None
        (plan,) = store.plans.list_plans("default", limit=9)
        assert plan.name == "Example flat"
    finally:
        store.close()


def test_example_of_the_page_is_that_of_the_checkout() -> None:
    page = Path(__file__).parents[2] / "service" / "web" / "example-flat.json"
    assert page.read_bytes() == PLAN_PATH.read_bytes()
