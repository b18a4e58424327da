"""How the cores that this process may use are shared out between what computes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUP = Path("/proc/self/cgroup")
# What LPO has of a query's processor time: a sixth where the heading is known, else a quarter.
_SHARE_OF_WORKERS = 0.25
_MAX_WORKERS = 64


@dataclass(frozen=True)
class CoreShares:
    """Threads that may compute at the same time: `workers` times `worker_threads` in the LPO workers, and
    `compute_threads` times `onnx_threads` in the service's own process.
    """

    workers: int
    worker_threads: int
    compute_threads: int
    onnx_threads: int

    @property
    def total(self) -> int:
        """Threads that compute when everything is busy."""
        return self.workers * self.worker_threads + self.compute_threads * self.onnx_threads


def share_cores(
    cores: int, *, workers: int | None, worker_threads: int, compute_threads: int, onnx_threads: int
) -> CoreShares:
    """Fill in what is left open: by the shares of queries and LPO, and one thread of each kind at least.

    On fewer than four cores one thread more computes than there are cores, as a single LPO worker is mostly idle.

    Args:
        cores: to be shared out.
        workers: LPO workers; None: open, 0: none.
        worker_threads, compute_threads, onnx_threads: 0: open. A network with one thread wastes nothing, so what is
            open about a single worker or query is one thread.
    """
    worker_threads, onnx_threads = worker_threads or 1, onnx_threads or 1
    if workers is None:
        workers = min(max(int(_SHARE_OF_WORKERS * cores) // worker_threads, 1), _MAX_WORKERS)
    if not compute_threads:
        busy = min(workers * worker_threads, int(_SHARE_OF_WORKERS * cores))
        compute_threads = max((cores - busy) // onnx_threads, 1)
    return CoreShares(workers, worker_threads, compute_threads, onnx_threads)


def usable_cores() -> int:
    """Cores that the scheduler gives this process: its affinity, and whole cores of its control group's quota."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(int(min(affinity, _quota_cores(_CGROUPS, _OWN_CGROUP))), 1)


def _quota_cores(cgroups: Path, own_cgroup: Path) -> float:
    """The least CPU quota, in cores, of this process' control group and those around it; infinite without one."""
    quotas = [float("inf")]
    try:
        lines = own_cgroup.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        lines = []
    unified = [line.removeprefix("0::/") for line in lines if line.startswith("0::/")]
    group = cgroups / unified[0] if unified else cgroups
    while group.is_relative_to(cgroups):
        quotas.append(_cores(_words(group / "cpu.max")))
        group = group.parent
    # Version 1, as a container sees it.
    v1 = cgroups / "cpu"
    quotas.append(_cores(_words(v1 / "cpu.cfs_quota_us") + _words(v1 / "cpu.cfs_period_us")))
    return min(quotas)


def _cores(quota_and_period: list[str]) -> float:
    """Microseconds of CPU per period of microseconds; a quota of "max" or -1 is none."""
    if len(quota_and_period) == 2 and all(word.isdecimal() for word in quota_and_period):
        quota, period = map(int, quota_and_period)
        return quota / period if quota and period else float("inf")
    return float("inf")


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split()
    except OSError:
        return []
