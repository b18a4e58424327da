"""Creating, listing and revoking keys on the command line, also while the service runs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from service.cli.entry_point import main
from tests.service.conftest import DatabaseOf, StartApp, assert_problem, upload

CREATE = ["keys", "create", "--tenant", "acme", "--name", "camera 7"]


@pytest.fixture
def data_dir(tmp_path: Path, database_of: DatabaseOf, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the data folder that the settings in the environment name."""
    monkeypatch.setenv("LALALOC_DATA_DIR", str(tmp_path / "data"))
    if not (url := database_of(tmp_path / "data")).startswith("sqlite"):
        monkeypatch.setenv("LALALOC_DATABASE_URL", url)
    return tmp_path / "data"


def _create(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main([*CREATE, *options]) == 0
    return capsys.readouterr().out.removesuffix("\n")


def test_key_works_at_once_until_it_is_revoked(
    data_dir: Path, start_app: StartApp, capsys: pytest.CaptureFixture[str]
) -> None:
    with start_app(data_dir, api_keys=True, key_cache_s=0.0) as client:
        key = _create(capsys, "--scope", "read", "--scope", "write")
        client.headers["Authorization"] = f"Bearer {key}"
        plan_id = upload(client)
        assert_problem(client.post("/localise"), 403, "insufficient-scope")
        assert main(["keys", "revoke", key.split("_")[1]]) == 0
        assert_problem(client.get(f"/floorplans/{plan_id}"), 401, "unauthenticated")


def test_only_the_key_is_printed(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = _create(capsys, "--scope", "localise", "--rate-per-minute", "30")
    assert re.fullmatch(r"lalaloc_[0-9a-f]{32}_[A-Za-z0-9_-]{43}", key)
    _, key_id, secret = key.split("_", 2)
    for options in ([], ["--json"]):
        assert main(["keys", "list", *options]) == 0
        printed = capsys.readouterr().out
        assert key_id in printed
        assert secret not in printed
        # The stored hash is not printed either.
        assert not re.search(r"[0-9a-f]{64}", printed)
    stored = [path for path in data_dir.rglob("*") if path.is_file()]
    assert not any(secret.encode() in path.read_bytes() for path in stored)


def test_list_shows_all_key_fields(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = _create(capsys, "--scope", "write", "--scope", "read").split("_")[1]
    assert main(["keys", "create", "--tenant", "other", "--name", "x", "--scope", "read"]) == 0
    assert main(["keys", "revoke", first]) == 0
    capsys.readouterr()
    assert main(["keys", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    keys = [(row["tenant"], row["name"], row["scopes"]) for row in rows]
    assert keys == [("acme", "camera 7", ["read", "write"]), ("other", "x", ["read"])]
    assert [row["revoked_at"] is None for row in rows] == [False, True]
    assert main(["keys", "list", "--tenant", "other"]) == 0
    table = capsys.readouterr().out.splitlines()
    head = ["ID", "TENANT", "NAME", "SCOPES", "RATE", "CREATED", "LAST", "USED", "EXPIRES", "REVOKED"]
    assert table[0].split() == head
    assert len(table) == 2
    assert table[1].split()[:5] == [rows[1]["id"], "other", "x", "read", "-"]


def test_key_is_revoked_once(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key_id = _create(capsys, "--scope", "read").split("_")[1]
    assert main(["keys", "revoke", key_id]) == 0
    assert main(["keys", "revoke", key_id]) == 1
    assert main(["keys", "revoke", "nobody"]) == 1
    assert "no active key 'nobody'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--scope"),
        (["--scope", "root"], "root"),
        (["--scope", "read", "--tenant", "../x"], "--tenant"),
        (["--scope", "read", "--tenant", "x" * 65], "1 to 64"),
        (["--scope", "read", "--name", ""], "--name"),
        (["--scope", "read", "--name", "a\nb"], "printable"),
        (["--scope", "read", "--rate-per-minute", "-1"], "--rate-per-minute"),
        (["--scope", "read", "--rate-per-minute", "1000001"], "0 to 1000000"),
        (["--scope", "read", "--expires-in", "0s"], "--expires-in"),
        (["--scope", "read", "--expires-in", "3661d"], "--expires-in"),
        (["--scope", "read", "--expires-in", "soon"], "--expires-in"),
    ],
)
def test_invalid_key_options_are_refused(
    data_dir: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*CREATE, *options])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not data_dir.exists()


def test_invalid_setting_prints_no_trace(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LALALOC_DATABASE_URL", "mysql://somewhere/else")
    assert main(["keys", "list"]) == 1
    assert "must be sqlite or postgresql" in capsys.readouterr().err
