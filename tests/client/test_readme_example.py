"""The README's Python example runs against the production app."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.service.conftest import StartApp

ROOT = Path(__file__).parents[2]


def test_readme_example_runs(
    start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    # The example's paths are relative to the repository.
    monkeypatch.chdir(ROOT)
    with start_app(tmp_path) as app:
        address = str(app.base_url).rstrip("/")
        for block in blocks:
            assert "http://127.0.0.1:8000" in block
            exec(block.replace("http://127.0.0.1:8000", address), {})
    assert re.search(r"\bPosition\(x_m=", capsys.readouterr().out)
