"""The processes of a running service: which there are, what they hold, and how to kill one (Linux)."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path


def descendants(pid: int) -> list[int]:
    """Process ids of the children of a process, theirs included."""
    return list(_below(pid))


def _below(pid: int) -> Iterator[int]:
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = path.read_text().split()
        except OSError:
            continue
        for child in children:
            yield int(child)
            yield from _below(int(child))


def command_line(pid: int) -> str:
    """What a process was started as, empty when it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def workers(pid: int) -> list[int]:
    """Worker processes of a service; not Python's own resource tracker."""
    return [child for child in descendants(pid) if "spawn_main" in command_line(child)]


def kill(pid: int) -> bool:
    """`kill -9`; False when there is no such process any more."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def resident_mb(pid: int) -> float:
    """Resident memory of a process in MB, 0 when it is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmRSS:")), 0.0)
