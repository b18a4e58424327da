"""The documentation agrees with the code: commands, links, generated parts and examples."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lalaloc_client
from examples.launch import running_service
from lalaloc_core.cli import main
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.annotations import read_annotation
from scripts.draw_pictures import IMAGES, pictures, shown
from scripts.write_docs import documents
from service.schemas import GeoPose, LocaliseAnswer
from service.schemas.plan_import import ImportReport

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(ROOT.glob("docs/**/*.md"))
README = PAGES[0].read_text(encoding="utf-8")
TUTORIAL = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def _blocks(language: str) -> list[tuple[str, str]]:
    """Return (page, content) of every fenced block in a language."""
    pattern = re.compile(rf"```{language}\n(.*?)```", re.DOTALL)
    return [(page.name, block) for page in PAGES for block in pattern.findall(page.read_text(encoding="utf-8"))]


def _commands() -> Iterator[list[str]]:
    """Yield every command in shell blocks and in running text, as words."""
    for _, block in _blocks("sh"):
        lines = block.replace("\\\n", " ").splitlines()
        yield from (shlex.split(line, comments=True) for line in lines if line.strip())
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            # Commands as they were in earlier versions.
            continue
        inline = re.findall(r"`((?:make|lalaloc|\.venv/bin/\w+) [^`]+)`", page.read_text(encoding="utf-8"))
        yield from (shlex.split(command) for command in inline)


COMMANDS = list(_commands())


def test_targets_and_modules_in_commands_exist() -> None:
    targets = {word for command in COMMANDS if command[0] == "make" for word in command[1:] if "=" not in word}
    assert targets >= {"demo", "serve", "test", "setup"}
    assert targets <= TARGETS
    modules = {command[command.index("-m") + 1] for command in COMMANDS if "python" in command[0] and "-m" in command}
    assert [name for name in sorted(modules) if importlib.util.find_spec(name) is None] == []


def _options() -> dict[tuple[str, ...], set[str]]:
    """Return the options in all commands by program; `plan` and `lab` have subcommands."""
    options: dict[tuple[str, ...], set[str]] = {}
    for command in (command for command in COMMANDS if command[0].endswith("lalaloc")):
        program = tuple(command[1 : 3 if command[1] in ("plan", "lab") else 2])
        options.setdefault(program, set()).update(word for word in command[2:] if word.startswith("--"))
    return options


@pytest.mark.parametrize(("program", "options"), _options().items(), ids=map(" ".join, _options()))
def test_options_in_commands_exist(
    program: tuple[str, ...], options: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main([*program, "--help"])
    assert exit_info.value.code == 0
    output = capsys.readouterr().out
    assert [option for option in options if option not in output] == []


def test_local_links_resolve() -> None:
    broken = []
    for page in PAGES:
        targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
        local = [target.partition("#")[0] for target in targets if "://" not in target]
        broken += [(page.name, target) for target in local if target and not (page.parent / target).exists()]
    assert broken == []


def test_generated_parts_are_up_to_date() -> None:
    stale = [path.name for path, text in documents().items() if path.read_text(encoding="utf-8") != text]
    assert stale == [], "run `make docs`"


def test_pictures_show_the_present_version() -> None:
    drawn = json.loads((IMAGES / "drawn.json").read_text(encoding="utf-8"))
    changed = [name for name, digest in shown().items() if drawn["shown"].get(name) != digest]
    assert changed == [], "docs/images shows these as they were: run `make pictures`"
    assert drawn["pictures"] == pictures(), "pictures were changed otherwise: run `make pictures`"
    linked = re.findall(r"!\[[^]]*\]\(\S*images/(\S+)\)", "".join(page.read_text("utf-8") for page in PAGES))
    assert set(linked) == drawn["pictures"].keys()


def test_json_examples_are_valid(tmp_path: Path) -> None:
    kinds = set()
    for page, block in _blocks("json"):
        document = json.loads(block)
        if "rooms" in document:
            FloorPlan.from_dict(document)
        elif "photograph" in document:
            Image.new("RGB", (1024, 512)).save(tmp_path / document["photograph"])
            (tmp_path / "example.json").write_text(block, encoding="utf-8")
            assert read_annotation(tmp_path / "example.json").counts
        elif "import_report" in document:
            ImportReport.model_validate(document["import_report"])
        elif "angles" in document:
            GeoPose.model_validate(document)
        elif "quaternion" in document:
            assert document.keys() == {"position", "quaternion"}
        elif "position" in document and "lat" not in document["position"]:
            assert document.keys() <= LocaliseAnswer.model_fields.keys()
        else:
            GeoPose.model_validate(document)
        kinds.add(page)
    assert "plan-format.md" in kinds


@pytest.mark.slow
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
    assert table.split()[:24] == expected.split()[:24]
    numbers, expected_numbers = (_numbers(text) for text in (table, expected))
    np.testing.assert_allclose(numbers[:2], expected_numbers[:2], atol=0.1)
    with Image.open("answer.png") as picture:
        assert picture.width == 1600
    kitchen, bedroom = json.loads(next(output for line, output in outputs.items() if "--json" in line))
    # The plan's lower left corner lies 0.5 m right of and 1 m above the picture's.
    assert kitchen["position"]["x_m"] == pytest.approx(7.1 + 0.5, abs=0.2)
    assert kitchen["position"]["y_m"] == pytest.approx(2.2 + 1.0, abs=0.2)
    assert bedroom["room"] != kitchen["room"]


def test_answer_of_the_readme_is_true(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    [(arguments, expected)] = re.findall(r"lalaloc (.*)\n```\n\n```\n(photograph (?:.*\n)*?)```", README)
    assert main(shlex.split(arguments)) == 0
    table = capsys.readouterr().out
    assert table.split()[:24] == expected.split()[:24]
    np.testing.assert_allclose(_numbers(table)[:2], _numbers(expected)[:2], atol=0.1)


@pytest.mark.parametrize("number", [0, 1], ids=["in this process", "over HTTP"])
def test_sessions_of_the_readme_have_their_results(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    session = re.findall(r"```pycon\n(.*?)```", README, re.DOTALL)[number]
    *statements, question = re.findall(r"^>>> (.*)$", session, re.MULTILINE)
    [expected] = re.findall(r"^\(.*$", session, re.MULTILINE)
    names: dict[str, Any] = vars(lalaloc_client).copy()
    code = "\n".join(statements)
    if "Client" in code:
        with running_service(0, {"LALALOC_DATA_DIR": str(tmp_path)}) as service:
            exec(code.replace("http://127.0.0.1:8000", service.url), names)
            names["service"].close()
    else:
        exec(code, names)
    room, position, confidence = eval(question, names)
    expected_room, expected_position, expected_confidence = eval(expected, vars(lalaloc_client).copy())
    assert room == expected_room
    assert (position.x_m, position.y_m) == pytest.approx((expected_position.x_m, expected_position.y_m), abs=0.1)
    assert confidence == pytest.approx(expected_confidence, abs=0.05)


def _numbers(table: str) -> list[float]:
    """Return x, y and heading in the last row of a table."""
    row = table.strip().splitlines()[-1]
    return [float(number) for number in re.findall(r"(?<= )\d+\.\d+(?= )", row)][:3]
