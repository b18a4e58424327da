"""CPU time per query of two checkouts of this repository, taken in turns, and the differences of their answers.

    git worktree add ../before v0.9.0
    python -m benchmarks.pairs ../before . --rounds 6 --clients 1 4

Each checkout runs the service of its own code with this interpreter. In every round each answers as many queries, in
changing order, so that other load on the machine affects both; the CPU time (user and system) of all processes is
counted, which load affects less than durations. Prints a Markdown table of medians over the rounds, and the largest
differences. Exits with 1 if an answer of one checkout is more than 1e-6 m, degrees or probability from the other's.

    taskset -c 0 python -m benchmarks.pairs ../before . --rounds 5 --figures

`--figures` measures one client with a photograph of 12 megapixels, a sphere, a turn, a film and two plans, four
clients, and the start of the service and of two commands instead. `--only NAME` chooses some of them.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np

from benchmarks import harness, pair_inputs
from examples.truth import PLAN_PATH, read_poses

_TIMEOUT_S, _WARM_UP = 120.0, 20
_SETTINGS = {**harness.UNLIMITED, "LALALOC_REQUEST_DEADLINE_S": "60"}
# Queries of a round for figures of single queries, and for those of four clients.
_SINGLE, _SEVERAL = 6, 40
_TOLERANCE = 1e-6


@dataclass(eq=False)
class Checkout:
    """Running service of the checkout in a folder, with the example plan."""

    name: str
    folder: Path
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
    parser.add_argument("--figures", action="store_true", help="measure the figures of all ways to localise")
    parser.add_argument("--only", action="append", choices=tuple(FIGURES), help="a figure of these; repeatable")
    options = parser.parse_args()
    with ExitStack() as stack:
        checkouts = [stack.enter_context(running_checkout(folder.resolve())) for folder in options.checkouts]
        if options.figures or options.only:
            print_figures(checkouts, options.rounds, options.only or list(FIGURES))
            return 0
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


class Spent(NamedTuple):
    """Duration of a piece of work and CPU time of all processes for it (s); NaN if it was not measured."""

    wall_s: float
    cpu_s: float


def _sent(send: Callable[[httpx.Client, Checkout], httpx.Response], repeats: int = 1) -> Callable[[Checkout], Spent]:
    """Return the measurement of a request, a mean of several if they are short."""

    def measure(checkout: Checkout) -> Spent:
        with httpx.Client(base_url=checkout.service.url, timeout=_TIMEOUT_S) as client:
            before_s, begin = harness.cpu_s(checkout.service.process), time.perf_counter()
            for _ in range(repeats):
                send(client, checkout).raise_for_status()
            wall_s = (time.perf_counter() - begin) / repeats
            return Spent(wall_s, (harness.cpu_s(checkout.service.process) - before_s) / repeats)

    return measure


def _photograph(client: httpx.Client, checkout: Checkout) -> httpx.Response:
    content, fields = pair_inputs.photograph()
    data = {"floorplan_id": checkout.service.plan_id, **fields}
    return client.post("/localise", data=data, files={"photo": ("p.jpg", content, "image/jpeg")})


def _sphere(client: httpx.Client, checkout: Checkout, *, known: bool) -> httpx.Response:
    query = harness.query_of(read_poses()[0], floorplan_id=checkout.service.plan_id)
    if not known:
        del query["data"]["heading_deg"]
    return client.post("/localise", **query)


def _sequence(client: httpx.Client, checkout: Checkout, name: str, contents: Sequence[bytes]) -> httpx.Response:
    data = {"floorplan_id": checkout.service.plan_id, "motion": "turn", "hfov_deg": "53"}
    return client.post("/localise/sequence", data=data, files=[(name, ("p", content)) for content in contents])


def _four_clients(checkout: Checkout) -> Spent:
    """Return the time per answer of four clients."""
    burst = checkout.burst(_SEVERAL, 4, known=False)
    return Spent(1.0 / burst.per_second, burst.cpu_ms / 1e3)


def _spread(checkout: Checkout) -> Spent:
    """Return the 99th percentile of four clients over the median of one, in place of a duration."""
    one, four = (checkout.burst(_SEVERAL, clients, known=False).durations_ms for clients in (1, 4))
    return Spent(float(np.quantile(four, 0.99) / np.median(one)), float("nan"))


def _localisability(name: str) -> Callable[[Checkout], Spent]:
    """Return the measurement of the first request for a new plan."""

    def measure(checkout: Checkout) -> Spent:
        with httpx.Client(base_url=checkout.service.url, timeout=_TIMEOUT_S) as client:
            stored = client.post("/floorplans", files={"file": (f"{name}.json", pair_inputs.plan(name))})
            place = f"/floorplans/{stored.raise_for_status().json()['id']}"
            harness.wait_until(lambda: client.get(place).json()["status"] == "ready", "the plan is ready", _TIMEOUT_S)
            spent = _sent(lambda client, _: client.get(f"{place}/localisability"))(checkout)
            client.delete(place).raise_for_status()
            return spent

    return measure


def _command(*arguments: str) -> Callable[[Checkout], Spent]:
    """Return the measurement of a command of a checkout's own code."""
    program = "import sys; from lalaloc_core.cli import main; sys.exit(main())"

    def measure(checkout: Checkout) -> Spent:
        environment, begin = {**os.environ, "PYTHONPATH": str(checkout.folder)}, time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments], cwd=checkout.folder, env=environment, stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"'lalaloc {' '.join(arguments)}' ended with status {process.returncode}")
        return Spent(time.perf_counter() - begin, usage.ru_utime + usage.ru_stime)

    return measure


def _start(checkout: Checkout) -> Spent:
    """Return the time from the start of another service to its readiness."""
    begin = time.perf_counter()
    with (
        tempfile.TemporaryDirectory() as data,
        harness.started_service(Path(data), harness.UNLIMITED, checkout.folder) as service,
    ):
        return Spent(time.perf_counter() - begin, harness.cpu_s(service.process))


# Measurements by name; inputs are made when they are first needed.
FIGURES: Mapping[str, Callable[[Checkout], Spent]] = {
    "photograph of 12 megapixels": _sent(_photograph, _SINGLE),
    "sphere, heading known": _sent(lambda client, checkout: _sphere(client, checkout, known=True), _SINGLE),
    "sphere, heading unknown": _sent(lambda client, checkout: _sphere(client, checkout, known=False), _SINGLE),
    "four clients, per answer": _four_clients,
    "p99 of four over p50 of one": _spread,
    "turn of twelve photographs": _sent(
        lambda client, checkout: _sequence(client, checkout, "photo", pair_inputs.turn())
    ),
    "film of 10 s, 1080p": _sent(lambda client, checkout: _sequence(client, checkout, "film", [pair_inputs.film()])),
    "localisability, example flat": _localisability("flat"),
    "localisability, office of 2,000 m²": _localisability("office"),
    "lalaloc --help": _command("--help"),
    "lalaloc localise": _command("localise", str(PLAN_PATH), str(read_poses()[0].picture), "--json"),
    "service, start to ready": _start,
}


def print_figures(checkouts: Sequence[Checkout], rounds: int, names: Sequence[str]) -> None:
    """Print the medians of figures over rounds in which the checkouts take turns, after a round as a warm-up.

    Ratios are medians of the ratios within a round.
    """
    before, after = (checkout.name for checkout in checkouts)
    harness.print_table_head("figure", before, after, "ratio", f"CPU, {before}", f"CPU, {after}", "ratio")
    for name in names:
        if name.startswith("film") and not pair_inputs.can_film():
            print(harness.table_row(name, *["needs FFmpeg"] * 2, *[""] * 4), flush=True)
            continue
        found: list[list[Spent]] = []
        for index in range(rounds + 1):
            spent = {checkout.name: FIGURES[name](checkout) for checkout in checkouts[:: 1 if index % 2 else -1]}
            found.append([spent[before], spent[after]])
        values = np.array(found[1:])
        cells: list[str] = []
        for kind in range(2):
            medians = np.median(values[:, :, kind], axis=0)
            ratio = np.median(values[:, 1, kind] / values[:, 0, kind])
            unit = "{:.2f}" if "over" in name else "{:.3f} s"
            cells += ["-"] * 3 if np.isnan(ratio) else [*map(unit.format, medians), f"{ratio:.2f}"]
        print(harness.table_row(name, *cells), flush=True)


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
    with harness.example_service(_SETTINGS, folder) as service:
        yield Checkout(folder.name, folder, service)


if __name__ == "__main__":
    sys.exit(main())
