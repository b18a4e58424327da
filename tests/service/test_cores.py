"""Division of the cores and of memory."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from service.capacity.cores import CoreShares, _quota_cores, share_cores, usable_cores


def test_open_shares_use_every_core_once() -> None:
    for cores in range(4, 130):
        shares = share_cores(cores, workers=None, compute_threads=0, onnx_threads=0)
        assert shares.workers + shares.compute_threads * shares.onnx_threads == cores
        assert min(shares.workers, shares.compute_threads) >= 1


def test_few_cores_are_not_divided_and_given_numbers_are_kept() -> None:
    for cores in (1, 2, 3):
        assert share_cores(cores, workers=None, compute_threads=0, onnx_threads=0) == CoreShares(1, cores, 1)
    assert share_cores(8, workers=0, compute_threads=0, onnx_threads=2) == CoreShares(0, 4, 2)
    assert share_cores(2, workers=3, compute_threads=5, onnx_threads=1) == CoreShares(3, 5, 1)


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


_ARENAS = """
import ctypes, os, sys, threading
from service.capacity.cores import limit_arenas

is_limited = limit_arenas(3)
libc, meet = ctypes.CDLL(None), threading.Barrier(8)
libc.fdopen.restype, libc.fdopen.argtypes = ctypes.c_void_p, (ctypes.c_int, ctypes.c_char_p)
libc.malloc_info.argtypes = (ctypes.c_int, ctypes.c_void_p)
libc.fflush.argtypes = (ctypes.c_void_p,)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)

def use_memory():
    block = libc.malloc(4096)
    meet.wait()
    libc.free(block)

threads = [threading.Thread(target=use_memory) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(is_limited, flush=True)
stream = libc.fdopen(1, b"w")
libc.malloc_info(0, stream)
libc.fflush(stream)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries divide memory in other ways")
@pytest.mark.parametrize("given", [None, "7"])
def test_threads_share_arenas_of_memory(given: str | None) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}
    environment |= {} if given is None else {"MALLOC_ARENA_MAX": given}
    answer = subprocess.run(
        [sys.executable, "-c", _ARENAS], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert answer.startswith("True" if given is None else "False")
    # Eight threads that hold memory at once, in as many arenas as they may use.
    assert answer.count("<heap nr=") == (3 if given is None else 7)
