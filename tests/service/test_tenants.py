"""Tenants: the operator's limits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.cli import main
from service.storage.records import OperatorLimits
from service.storage.store import Store
from tests.service.conftest import DatabaseOf


@pytest.fixture
def url(tmp_path: Path, database_of: DatabaseOf, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the URL of the database that the settings in the environment name."""
    address = database_of(tmp_path)
    monkeypatch.setenv("LALALOC_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("LALALOC_DATABASE_URL", address)
    return address


def test_limits_are_set_and_reset(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tenants", "limit", "acme", "--stored-bytes", "1000", "--cpu-share", "0.5"]) == 0
    assert main(["tenants", "limit", "acme", "--bytes-in-flight", "2000", "--cpu-share", "default"]) == 0
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "stored_bytes: 1000",
        "bytes_in_flight: 2000",
        "cpu_share: default",
    ]
    assert main(["tenants", "list", "--json"]) == 0
    [listed] = json.loads(capsys.readouterr().out)
    assert listed == {"tenant": "acme", "stored_bytes": 1000, "bytes_in_flight": 2000, "cpu_share": None}
    assert main(["tenants", "list"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["acme", "1000", "2000", "default"]


@pytest.mark.parametrize(
    "options",
    [["--stored-bytes", "-1"], ["--stored-bytes", str(2**63)], ["--cpu-share", "0"], ["--cpu-share", "nan"]],
)
def test_invalid_limit_is_a_usage_error(url: str, options: list[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["tenants", "limit", "acme", *options])
    assert exit_info.value.code == 2


def test_limits_in_memory_follow_the_database(url: str) -> None:
    store, operator = Store(url), Store(url)
    assert store.tenant_limits.of("acme") == OperatorLimits()
    operator.tenants.change_limits("acme", stored_bytes=2**40)
    store.tenant_limits.refresh()
    assert store.tenant_limits.of("acme") == OperatorLimits(stored_bytes=2**40)
    assert store.tenant_limits.of("other") == OperatorLimits()
    operator.tenants.change_limits("acme", stored_bytes=None)
    store.tenant_limits.refresh()
    assert store.tenant_limits.of("acme") == OperatorLimits()
    for opened in (store, operator):
        opened.close()
