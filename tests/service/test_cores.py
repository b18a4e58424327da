"""Division of the cores."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.cores import CoreShares, _quota_cores, share_cores, usable_cores


@pytest.mark.parametrize("cores", range(4, 130))
def test_open_shares_use_every_core_once(cores: int) -> None:
    shares = share_cores(cores, workers=None, worker_threads=0, compute_threads=0, onnx_threads=0)
    assert shares.total == cores
    assert min(shares.workers, shares.compute_threads) >= 1


@pytest.mark.parametrize("cores", [1, 2, 3])
def test_single_lpo_worker_takes_no_core_of_few(cores: int) -> None:
    shares = share_cores(cores, workers=None, worker_threads=0, compute_threads=0, onnx_threads=0)
    assert shares == CoreShares(1, 1, cores, 1)


def test_given_numbers_are_kept() -> None:
    assert share_cores(8, workers=0, worker_threads=0, compute_threads=0, onnx_threads=2) == CoreShares(0, 1, 4, 2)
    assert share_cores(8, workers=None, worker_threads=2, compute_threads=0, onnx_threads=0) == CoreShares(1, 2, 6, 1)
    assert share_cores(2, workers=3, worker_threads=1, compute_threads=5, onnx_threads=1) == CoreShares(3, 1, 5, 1)


def test_usable_cores_follow_the_affinity() -> None:
    assert 1 <= usable_cores() <= len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, float("inf")),
        ({"cpu.max": "max 100000"}, float("inf")),
        ({"cpu.max": "150000 100000"}, 1.5),
        ({"a/b/cpu.max": "400000 100000", "a/cpu.max": "300000 100000"}, 3.0),
        ({"a/b/cpu.max": "nonsense"}, float("inf")),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, float("inf")),
        ({"cpu/cpu.cfs_quota_us": "250000", "cpu/cpu.cfs_period_us": "100000"}, 2.5),
    ],
)
def test_smallest_cgroup_quota_counts(tmp_path: Path, files: dict[str, str], expected: float) -> None:
    own = tmp_path / "cgroup"
    own.write_text("0::/a/b\n")
    for name, content in files.items():
        path = tmp_path / "fs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content + "\n")
    assert _quota_cores(tmp_path / "fs", own) == expected
