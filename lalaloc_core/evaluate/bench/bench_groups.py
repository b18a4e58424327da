"""Groups of benchmarks by name, and the runner of `lalaloc bench`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from lalaloc_core.errors import ConfigError
from lalaloc_core.evaluate.bench.accuracy import (
    GROUPS,
    bench_azimuths,
    bench_localisability,
    bench_uninformative,
    measure,
)
from lalaloc_core.evaluate.bench.album_weights import bench_album_weights
from lalaloc_core.evaluate.bench.albums import bench_albums
from lalaloc_core.evaluate.bench.house import bench_house
from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.bench.service_latency import bench_service
from lalaloc_core.evaluate.bench.steps import bench_steps
from lalaloc_core.evaluate.bench.turns import bench_films, bench_turns

_FUNCTIONS = bench_service, bench_turns, bench_films, bench_steps, bench_albums, bench_house
_FUNCTIONS += bench_localisability, bench_uninformative, bench_azimuths, bench_album_weights
_BENCHMARKS: Mapping[str, Callable[[Setting], dict[str, Any]]] = {
    **{group: partial(measure, rows) for group, rows in GROUPS.items()},
    **{function.__name__.removeprefix("bench_"): function for function in _FUNCTIONS},
}
# Measured only on request: it takes hours, and chooses weights instead of measuring them.
_ON_REQUEST = ("album_weights",)


def run_bench(setting: Setting, groups: Sequence[str]) -> dict[str, Any]:
    """Measure groups of figures, by default all but those on request."""
    for number, group in enumerate(groups):
        if group not in _BENCHMARKS:
            raise ConfigError(f"only[{number}] is '{group}'; the groups are {', '.join(_BENCHMARKS)}")
    manifest = setting.bundle.manifest
    machine = {"bundle": manifest.name, "version": manifest.version, "cores": os.cpu_count()}
    chosen = groups or [group for group in _BENCHMARKS if group not in _ON_REQUEST]
    return machine | {group: _BENCHMARKS[group](setting) for group in chosen}
