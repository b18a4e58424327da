"""CPU time per query of two checkouts of this repository, taken in turns, and the differences of their answers.

    git worktree add ../before v0.9.0
    python -m benchmarks.pairs ../before . --rounds 6 --clients 1 4

Each checkout runs the service of its own code with this interpreter. In every round each answers as many queries, in
changing order, so that other load on the machine affects both; the CPU time (user and system) of all processes is
counted, which load affects less than durations. Prints a Markdown table of medians over the rounds, and the largest
differences. Exits with 1 if an answer of one checkout is more than 1e-6 m, degrees or probability from the other's.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks import harness
from examples.truth import read_poses

_TIMEOUT_S, _WARM_UP = 60.0, 20
_TOLERANCE = 1e-6


@dataclass(eq=False)
class Checkout:
    """Running service of a checkout, with the example plan."""

    name: str
    service: harness.Service
    answers: dict[tuple[bool, int], dict[str, Any]] = field(default_factory=dict)

    def ask(self, client: httpx.Client, number: int, *, known: bool) -> float:
        """Localise an example panorama; return the duration (s)."""
        poses = read_poses()
        query = harness.query_of(poses[number % len(poses)], floorplan_id=self.service.plan_id)
        if not known:
            del query["data"]["heading_deg"]
        begin = time.perf_counter()
        response = client.post("/localise", **query).raise_for_status()
        duration_s = time.perf_counter() - begin
        self.answers[known, number % len(poses)] = response.json()
        return duration_s

    def burst(self, queries: int, clients: int, *, known: bool) -> Burst:
        """Answer queries of several clients; return CPU time per query, duration and rate."""
        before_s, begin = harness.cpu_s(self.service.process), time.perf_counter()
        with ThreadPoolExecutor(clients) as threads:
            parts = threads.map(lambda first: self._series(range(first, queries, clients), known=known), range(clients))
            durations_s = [duration for part in parts for duration in part]
        wall_s = time.perf_counter() - begin
        spent_s = harness.cpu_s(self.service.process) - before_s
        return Burst(1e3 * spent_s / queries, [1e3 * s for s in durations_s], queries / wall_s)

    def _series(self, numbers: Sequence[int], *, known: bool) -> list[float]:
        with httpx.Client(base_url=self.service.url, timeout=_TIMEOUT_S) as client:
            return [self.ask(client, number, known=known) for number in numbers]


@dataclass(frozen=True)
class Burst:
    """CPU time per query (ms), duration of each (ms) and queries per second."""

    cpu_ms: float
    durations_ms: list[float]
    per_second: float


def main() -> int:
    """Measure; return 1 when answers differ."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("checkouts", nargs=2, type=Path, help="folders of the checkouts, the one before first")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--queries", type=int, default=80, help="queries of each checkout and round")
    parser.add_argument("--clients", type=int, nargs="*", default=(1, 4))
    options = parser.parse_args()
    with ExitStack() as stack:
        checkouts = [stack.enter_context(running_checkout(folder.resolve())) for folder in options.checkouts]
        harness.print_table_head("heading", "clients", "checkout", "CPU per query", "p50", "p99", "queries/s")
        for known in (True, False):
            for clients in options.clients:
                for row in _rows(checkouts, options.rounds, options.queries, clients, known=known):
                    print(row, flush=True)
    differences = differences_of(*checkouts)
    print("\nLargest differences: " + ", ".join(f"{name} {value:.1e}" for name, value in differences.items()))
    return int(max(differences.values()) > _TOLERANCE)


def bursts_of(
    checkouts: Sequence[Checkout], rounds: int, queries: int, clients: int, *, known: bool
) -> dict[str, Burst]:
    """Let checkouts answer queries in turns; return the median of their CPU times and rates, and all durations."""
    for checkout in checkouts:
        checkout.burst(_WARM_UP, clients, known=known)
    bursts: dict[str, list[Burst]] = {checkout.name: [] for checkout in checkouts}
    for index in range(rounds):
        for checkout in checkouts if index % 2 else reversed(checkouts):
            bursts[checkout.name].append(checkout.burst(queries, clients, known=known))
    return {
        name: Burst(
            statistics.median(burst.cpu_ms for burst in found),
            [duration for burst in found for duration in burst.durations_ms],
            statistics.median(burst.per_second for burst in found),
        )
        for name, found in bursts.items()
    }


def _rows(checkouts: Sequence[Checkout], rounds: int, queries: int, clients: int, *, known: bool) -> Iterator[str]:
    for name, burst in bursts_of(checkouts, rounds, queries, clients, known=known).items():
        p50, p99 = np.quantile(burst.durations_ms, [0.5, 0.99])
        times = f"{burst.cpu_ms:.1f} ms", f"{p50:.0f} ms", f"{p99:.0f} ms"
        yield harness.table_row("known" if known else "unknown", clients, name, *times, f"{burst.per_second:.1f}")


def differences_of(before: Checkout, after: Checkout) -> dict[str, float]:
    """Return the largest absolute differences of the answers to equal queries."""
    largest: dict[str, float] = {"position (m)": 0.0, "heading (°)": 0.0, "confidence": 0.0}
    for key, old in before.answers.items():
        new = after.answers[key]
        turned = (new["heading_deg"] - old["heading_deg"] + 180.0) % 360.0 - 180.0
        moved = max(abs(new["position"][axis] - old["position"][axis]) for axis in ("x_m", "y_m"))
        found = moved, abs(turned), abs((new["confidence"] or 0.0) - (old["confidence"] or 0.0))
        largest = {name: max(value, part) for (name, value), part in zip(largest.items(), found, strict=True)}
    return largest


@contextmanager
def running_checkout(folder: Path) -> Iterator[Checkout]:
    """Run the service of the checkout in a folder, with a temporary data folder and the example plan."""
    with harness.example_service(harness.UNLIMITED, folder) as service:
        yield Checkout(folder.name, service)


if __name__ == "__main__":
    sys.exit(main())
