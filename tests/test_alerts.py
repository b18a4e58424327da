"""Alerts for Prometheus: they fire when they should, and each leads to its runbook."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.cli.entry_point import build_parser

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docker" / "grafana"
RUNBOOKS = (ROOT / "docs" / "how-to" / "runbooks.md").read_text(encoding="utf-8")
GROUPS: list[dict[str, Any]] = yaml.safe_load((FOLDER / "alerts.yaml").read_text(encoding="utf-8"))["groups"]
RULES = [rule for group in GROUPS for rule in group["rules"]]
ALERTS = {rule["alert"]: rule for rule in RULES if "alert" in rule}


@pytest.mark.parametrize(
    "command",
    [("test", "rules", "alerts.test.yaml"), ("check", "config", "prometheus.yaml")],
    ids=lambda command: command[0],
)
def test_rules_pass_their_tests(command: tuple[str, ...]) -> None:
    program = shutil.which("promtool")
    if program is None:
        pytest.skip("promtool is not installed; on Debian and Ubuntu the package is prometheus")
    done = subprocess.run([program, *command], cwd=FOLDER, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_alert_is_seen_to_fire_and_to_be_silent() -> None:
    tests = yaml.safe_load((FOLDER / "alerts.test.yaml").read_text(encoding="utf-8"))["tests"]
    cases = [case for test in tests for case in test["alert_rule_test"]]
    assert {case["alertname"] for case in cases if case.get("exp_alerts")} == ALERTS.keys()
    assert {case["alertname"] for case in cases if not case.get("exp_alerts")} == ALERTS.keys()


def test_every_alert_leads_to_its_runbook() -> None:
    sections = dict(re.findall(r"^## (.+)\n\n(.+(?:\n.+)*)", RUNBOOKS, re.MULTILINE))
    anchors = {title.lower().replace(" ", "-"): text for title, text in sections.items()}
    for name, rule in ALERTS.items():
        address, _, anchor = rule["annotations"]["runbook_url"].partition("#")
        assert address == "{{ $externalLabels.lalaloc_docs }}/how-to/runbooks.html"
        # The runbook names the alert, so that both are found from each other.
        assert f"`{name}`" in anchors[anchor]
    assert set(re.findall(r"`(LaLaLoc\w+)`", RUNBOOKS)) == ALERTS.keys()


def test_commands_of_the_runbooks_exist() -> None:
    commands = re.findall(r"\.venv/bin/lalaloc-service ([^`|\n]+)", RUNBOOKS)
    assert len(commands) > 8
    for command in commands:
        build_parser().parse_args(shlex.split(command))
