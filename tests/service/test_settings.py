"""Settings from the environment: typed, grouped, unknown names refused."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from lalaloc_core.errors import ConfigError
from service.settings import PREFIX, SETTING_NAMES, Settings, settings_table
from service.settings.settings import EARLIER_NAMES

ROOT = Path(__file__).parents[2]
# Variables of the container's own programs, of proxies and of clients.
OF_OTHERS = {"api_key", "database_password", "host", "http_port", "https_port", "key", "memory", "publish", "upstream"}
INVALID = [
    ("WORKERS", "-1"),
    ("WORKERS", "two"),
    ("REQUEST_DEADLINE_S", "nan"),
    ("GRID_STEP_M", "0"),
    ("LOG_LEVEL", "loud"),
]
UNKNOWN = ("DATADIR", "/tmp/x", "LALALOC_DATA_DIR")


@pytest.mark.parametrize(("name", "value", "named"), [UNKNOWN, *((name, value, value) for name, value in INVALID)])
def test_invalid_setting_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str, named: str) -> None:
    monkeypatch.setenv(PREFIX + name, value)
    with pytest.raises(ConfigError, match=PREFIX + name) as raised:
        Settings.load()
    assert named in str(raised.value)


def test_values_are_read_and_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LALALOC_DATA_DIR", "/srv/plans")
    monkeypatch.setenv("LALALOC_WORKERS", "3")
    monkeypatch.setenv("LALALOC_MAX_PLAN_BYTES", "7")
    monkeypatch.setenv("LALALOC_DATABASE_URL", "")
    settings = Settings.load()
    assert settings.data_dir == Path("/srv/plans")
    assert settings.compute.workers == 3
    assert settings.plans.import_limits.max_plan_bytes == 7
    assert settings.database_url == "sqlite:////srv/plans/lalaloc.sqlite3"


def test_removed_setting_is_ignored_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(logging.getLogger("lalaloc"), "propagate", True)
    monkeypatch.setenv("LALALOC_DECODE_QUEUE", "3")
    monkeypatch.setenv("LALALOC_MAX_ROOMS", "7")
    with caplog.at_level(logging.WARNING, logger="lalaloc"):
        Settings.load()
    assert "LALALOC_DECODE_QUEUE is ignored" in caplog.text
    assert "LALALOC_MAX_ROOMS is ignored" in caplog.text


def test_settings_named_in_pages_and_in_messages_exist() -> None:
    patterns = ("docs/**/*.md", "docker/**/*", "service/**/*.py", "lalaloc_core/**/*.py", "examples/*.py")
    files = [path for pattern in patterns for path in ROOT.glob(pattern)]
    known = SETTING_NAMES | EARLIER_NAMES.keys() | OF_OTHERS
    for path in files:
        if path.is_file() and path.suffix not in {".png", ".jpg"}:
            named = re.findall(r"\bLALALOC_([A-Z][A-Z_]*[A-Z])\b", path.read_text(encoding="utf-8"))
            assert {name.lower() for name in named} <= known, path


def test_settings_are_few_and_all_in_the_table() -> None:
    assert len(SETTING_NAMES) <= 55
    rows = [line for line in settings_table().splitlines() if line.startswith("| `")]
    assert len(rows) == len(SETTING_NAMES)
    assert all(len(row.split("|")[3].strip()) > 10 for row in rows)


def test_earlier_name_of_a_setting_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LALALOC_MAX_SEQUENCE_PANORAMAS", "7")
    assert Settings.load().photographs.max_sequence_photographs == 7
    assert Settings(max_panorama_bytes=9).value("max_panorama_bytes") == 9
    monkeypatch.setenv("LALALOC_MAX_SEQUENCE_PHOTOGRAPHS", "7")
    with pytest.raises(ConfigError, match="LALALOC_MAX_SEQUENCE_PANORAMAS is the earlier name of"):
        Settings.load()


def test_settings_cannot_change_once_read() -> None:
    settings = Settings.load()
    with pytest.raises(ValidationError):
        settings.compute.workers = 5  # pyright: ignore[reportAttributeAccessIssue]


def test_default_bundle_is_independent_of_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert Settings.load().bundle == Path(__file__).parents[2] / "models" / "default"
