"""Division of the usable cores between LPO workers and the main process, and of memory between threads."""

from __future__ import annotations

import ctypes
import os
import platform
from dataclasses import dataclass
from pathlib import Path

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUP = Path("/proc/self/cgroup")
# LPO's share of a query's processor time: a sixth with a known heading, else a quarter.
_SHARE_OF_WORKERS = 0.25
_MAX_WORKERS = 64
# Parameter of mallopt(3).
_M_ARENA_MAX = -8


@dataclass(frozen=True)
class CoreShares:
    """Numbers of computing threads.

    LPO workers run one thread each, which is most efficient, the main process `compute_threads` times `onnx_threads`.
    """

    workers: int
    compute_threads: int
    onnx_threads: int


def share_cores(cores: int, *, workers: int | None, compute_threads: int, onnx_threads: int) -> CoreShares:
    """Return the numbers of threads, and choose those left open, with at least one thread each.

    Open are `workers` if None, `compute_threads`, for the remaining cores, and `onnx_threads` per network if 0.
    There is one thread more than cores if these are fewer than four, because a single LPO worker is mostly idle.
    """
    onnx_threads = onnx_threads or 1
    if workers is None:
        workers = min(max(int(_SHARE_OF_WORKERS * cores), 1), _MAX_WORKERS)
    if not compute_threads:
        busy = min(workers, int(_SHARE_OF_WORKERS * cores))
        compute_threads = max((cores - busy) // onnx_threads, 1)
    return CoreShares(workers, compute_threads, onnx_threads)


def usable_cores() -> int:
    """Return the usable cores: the affinity, limited by the quota of the cgroup."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(int(min(affinity, _quota_cores(_CGROUPS, _OWN_CGROUP))), 1)


def limit_arenas(cores: int) -> bool:
    """Let the threads of this process share as many arenas of memory as it has cores; return whether they do.

    By default, glibc gives each core eight arenas, each of which keeps memory that its threads freed. Call it before
    threads start. The variable MALLOC_ARENA_MAX takes precedence; other libraries than glibc are left as they are.
    """
    if "MALLOC_ARENA_MAX" in os.environ or platform.libc_ver()[0] != "glibc":
        return False
    return ctypes.CDLL(None).mallopt(_M_ARENA_MAX, max(cores, 2)) == 1


def _quota_cores(cgroups: Path, own_cgroup: Path) -> float:
    """Return the smallest CPU quota, in cores, of the cgroup and its parents; infinite without one."""
    unified = [word.removeprefix("0::/") for word in _words(own_cgroup) if word.startswith("0::/")]
    group = cgroups / unified[0] if unified else cgroups
    groups = [group, *group.parents]
    quotas = [_cores(_words(each / "cpu.max")) for each in groups if each.is_relative_to(cgroups)]
    # cgroup v1, as seen in a container.
    v1 = cgroups / "cpu"
    quotas.append(_cores(_words(v1 / "cpu.cfs_quota_us") + _words(v1 / "cpu.cfs_period_us")))
    return min(quotas)


def _cores(quota_and_period: list[str]) -> float:
    """Return quota divided by period; infinite for "max", -1 or unreadable values."""
    if len(quota_and_period) == 2 and all(word.isdecimal() for word in quota_and_period):
        quota, period = map(int, quota_and_period)
        return quota / period if quota and period else float("inf")
    return float("inf")


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii", errors="replace").split()
    except OSError:
        return []
