"""The tutorial's commands lead to the answer that it shows."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lalaloc_core.cli import main

ROOT = Path(__file__).parents[1]
TUTORIAL = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")


def test_tutorial_leads_to_its_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    monkeypatch.chdir(tmp_path)
    outputs = {}
    for block in re.findall(r"```sh\n(.*?)```", TUTORIAL, re.DOTALL):
        for line in block.strip().splitlines():
            program, *arguments = shlex.split(line)
            assert program == ".venv/bin/lalaloc"
            assert main(arguments) == 0, line
            outputs[line] = capsys.readouterr().out
    (table,) = (output for line, output in outputs.items() if "answer.png" in line)
    (expected,) = re.findall(r"```\n(photograph .*?)```", TUTORIAL, re.DOTALL)
    assert table.split()[:11] == expected.split()[:11]
    numbers, expected_numbers = (_numbers(text) for text in (table, expected))
    np.testing.assert_allclose(numbers[:2], expected_numbers[:2], atol=0.1)
    with Image.open("answer.png") as picture:
        assert picture.width == 1600
    kitchen, bedroom = json.loads(next(output for line, output in outputs.items() if "--json" in line))
    # The plan's lower left corner lies 0.5 m right of and 1 m above the picture's.
    assert kitchen["position"]["x_m"] == pytest.approx(7.1 + 0.5, abs=0.2)
    assert kitchen["position"]["y_m"] == pytest.approx(2.2 + 1.0, abs=0.2)
    assert bedroom["room"] != kitchen["room"]


def _numbers(table: str) -> list[float]:
    """Return x, y and heading in the last row of a table."""
    row = table.strip().splitlines()[-1]
    return [float(number) for number in re.findall(r"(?<= )\d+\.\d+(?= )", row)][:3]
