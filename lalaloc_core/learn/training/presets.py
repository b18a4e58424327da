"""Presets of `lalaloc lab train --preset`, of `presets.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lalaloc_core.learn.training.config import TrainConfig


def _read() -> dict[str, TrainConfig]:
    presets: dict[str, TrainConfig] = {}
    for name, values in tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8")).items():
        base = presets[values.pop("base")].to_dict() if "base" in values else {}
        presets[name] = TrainConfig.from_dict(_changed(base, values) | {"name": name})
    return presets


def _changed(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with others in their place."""
    return {**base} | {
        key: _changed(base.get(key, {}), value) if isinstance(value, dict) else value for key, value in values.items()
    }


PRESETS = _read()
