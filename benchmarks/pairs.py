"""Durations and CPU times of two checkouts of this repository, taken in turns, and the differences of their answers.

    git worktree add ../before v0.7.0
    taskset -c 0 python -m benchmarks.pairs ../before . --rounds 5
    python -m benchmarks.pairs

Each checkout runs the service of its own code with this interpreter. In every round each does the same work, in
changing order, so that other load on the machine affects both; the CPU time (user and system) of all processes is
counted, which load affects less than durations. The work is a photograph of 12 megapixels, spheres, a turn, a film and
two plans by one client, four clients, and the start of the service and of two commands; `--only NAME` chooses some of
it. Prints a Markdown table of medians over the rounds, and the largest differences of the answers to spheres. Exits
with 1 if one is more than 1e-6 m, degrees or probability. `--json` stores the figures of a release, and its stages.

Without checkouts, the stages of answers about the example flat are measured in this one, each over fixed work of the
same run, so that the machine and its load count little. A warning names those that grew by more than 20 % since the
last stored release.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import timeit
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
from PIL import Image

from benchmarks import harness
from benchmarks.buildings import Building
from examples.launch import ROOT
from examples.truth import FOLDER, PLAN_PATH, read_poses
from lalaloc_core.evaluate.bench.service_latency import PHONE_FIELD_DEG, phone_photograph
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.learn.synth.homes.plans import VALIDATION
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.photograph.photograph import open_picture

_TIMEOUT_S = 120.0
_SETTINGS = {**harness.UNLIMITED, "LALALOC_REQUEST_DEADLINE_S": "60"}
# Queries of a round for figures of single queries, and for those of four clients.
_SINGLE, _SEVERAL = 6, 40
_TOLERANCE = 1e-6
_TURN, _FIELD_DEG = 12, 53.0
# Frames of the film as they are drawn, at half of its size; FFmpeg repeats and enlarges them to 30 a second in 1080p.
_FRAMES, _FRAMES_PER_S = 100, 10
_OFFICE_M2 = 2000.0
# Figures and stages of releases. Rounds of stages, the shortest that is compared (ms), the factor from which one has
# grown, and the direction of a wall of the living room (degrees) that leaves the answer unsure.
_STORED = ROOT / "docs" / "pairs.json"
_STAGE_ROUNDS, _SHORTEST_MS, _GROWN, _WALL_DEG = 12, 1.0, 1.2, 220.0


@dataclass(eq=False)
class Checkout:
    """Running service of the checkout in a folder, with the example plan."""

    name: str
    folder: Path
    service: harness.Service
    answers: dict[tuple[bool, int], dict[str, Any]] = field(default_factory=dict)

    def ask(self, client: httpx.Client, number: int, *, known: bool) -> httpx.Response:
        """Localise an example photograph."""
        poses = read_poses()
        query = harness.query_of(poses[number % len(poses)], floorplan_id=self.service.plan_id)
        if not known:
            del query["data"]["heading_deg"]
        response = client.post("/localise", **query).raise_for_status()
        self.answers[known, number % len(poses)] = response.json()
        return response

    def burst(self, clients: int) -> tuple[Spent, list[float]]:
        """Answer queries of several clients with unknown headings; return the time per answer and each duration (s)."""
        watch = harness.Stopwatch(self.service.process)
        with ThreadPoolExecutor(clients) as threads:
            parts = threads.map(lambda first: self._series(range(first, _SEVERAL, clients)), range(clients))
            durations_s = [duration for part in parts for duration in part]
        return Spent(*(seconds / _SEVERAL for seconds in watch.times_s())), durations_s

    def _series(self, numbers: Sequence[int]) -> list[float]:
        with httpx.Client(base_url=self.service.url, timeout=_TIMEOUT_S) as client:
            return [self.ask(client, number, known=False).elapsed.total_seconds() for number in numbers]


class Spent(NamedTuple):
    """Duration of a piece of work and CPU time of all processes for it (s); NaN if it was not measured."""

    wall_s: float
    cpu_s: float


def main() -> int:
    """Measure; return 1 when answers differ."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("checkouts", nargs="*", type=Path, help="folders of two checkouts, the one before first")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--only", action="append", choices=tuple(FIGURES), help="a figure of these; repeatable")
    parser.add_argument("--json", type=Path, help="file to add figures and stages of the second checkout to")
    options = parser.parse_args()
    if not options.checkouts:
        version, release = list(json.loads(_STORED.read_text()).items())[-1]
        for text in grown_stages(stage_ratios(ROOT), release["stages"]):
            print(f"warning: {text} than in {version}; see benchmarks/pairs.py", file=sys.stderr)
        return 0
    if len(options.checkouts) != 2:
        parser.error("give two checkouts, or none")
    with ExitStack() as stack:
        checkouts = []
        for folder in map(Path.resolve, options.checkouts):
            service = stack.enter_context(harness.example_service(_SETTINGS, folder))
            checkouts.append(Checkout(folder.name, folder, service))
        figures = _print_figures(checkouts, options.rounds, options.only or list(FIGURES))
    if options.json:
        texts = [(checkout.folder / "lalaloc_core/__init__.py").read_text() for checkout in checkouts]
        before, after = (re.findall(r'^__version__ = "(.+)"', text, re.MULTILINE)[0] for text in texts)
        releases = json.loads(options.json.read_text()) if options.json.exists() else {}
        releases[after] = {"before": before, "figures": figures, "stages": stage_ratios(checkouts[1].folder)}
        options.json.write_text(json.dumps(releases, indent=2) + "\n")
    differences = _differences(*checkouts)
    print("\nLargest differences: " + ", ".join(f"{name} {value:.1e}" for name, value in differences.items()))
    return int(max(differences.values()) > _TOLERANCE)


def stage_ratios(checkout: Path, rounds: int = _STAGE_ROUNDS) -> dict[str, float]:
    """Return the least duration of each stage of answers of a checkout's service, over that of fixed work like it."""
    camera = Perspective.of_hfov(480, 640, math.radians(_FIELD_DEG))
    wall = cut_view(_living_room(), camera, azimuth=math.radians(_WALL_DEG), pitch=0.0, roll=0.0)
    photographs: dict[str, tuple[bytes, dict[str, str]]] = {
        "sphere": ((FOLDER / "living_room.jpg").read_bytes(), {}),
        "phone": ((FOLDER / "phone.jpg").read_bytes(), {}),
        "wall": (encode_jpeg(wall), {"hfov_deg": f"{_FIELD_DEG:g}"}),
    }
    values = np.linspace(0.0, 1.0, 2**18, dtype=np.float32).reshape(512, 512)
    # Scattered sums take equally long whatever the instructions of a processor; sorting does not.
    places = np.random.default_rng(0).permutation(2**18)
    works: dict[str, Callable[[], object]] = {
        "decode": lambda: Image.open(FOLDER / "living_room.jpg").resize((256, 128)),
        "encode": lambda: values @ values,
        "others": lambda: np.bincount(places, weights=values.ravel()),
    }
    least_ms: defaultdict[tuple[str, str], float] = defaultdict(lambda: math.inf)
    with (
        harness.example_service(_SETTINGS, checkout) as service,
        httpx.Client(base_url=service.url, timeout=_TIMEOUT_S) as client,
    ):
        for _ in range(rounds):
            spent_ms = {("", stage): 1e3 * timeit.timeit(work, number=1) for stage, work in works.items()}
            for name, (content, fields) in photographs.items():
                data, files = {"floorplan_id": service.plan_id, **fields}, {"photo": (name, content)}
                timings_ms = client.post("/localise", data=data, files=files).raise_for_status().json()["timings_ms"]
                spent_ms |= {(name, stage): spent for stage, spent in timings_ms.items() if stage != "total"}
            least_ms |= {key: min(spent, least_ms[key]) for key, spent in spent_ms.items()}
    return {
        f"{name}: {stage}": round(spent / least_ms["", stage if stage in works else "others"], 4)
        for (name, stage), spent in least_ms.items()
        if name and spent >= _SHORTEST_MS
    }


def grown_stages(ratios: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a text for each stage whose ratio grew by more than 20 %."""
    grown = {name: ratio / stored.get(name, math.inf) for name, ratio in ratios.items()}
    return [f"stage {name} takes {factor - 1.0:.0%} longer" for name, factor in grown.items() if factor > _GROWN]


def _sent(send: Callable[[httpx.Client, Checkout], httpx.Response], repeats: int = 1) -> Callable[[Checkout], Spent]:
    """Return the measurement of a request, a mean of several if they are short."""

    def measure(checkout: Checkout) -> Spent:
        with httpx.Client(base_url=checkout.service.url, timeout=_TIMEOUT_S) as client:
            watch = harness.Stopwatch(checkout.service.process)
            for _ in range(repeats):
                send(client, checkout).raise_for_status()
            return Spent(*(seconds / repeats for seconds in watch.times_s()))

    return measure


def _living_room() -> np.ndarray:
    (living_room,) = (pose for pose in read_poses() if pose.file == "living_room.jpg")
    return open_picture(living_room.picture.read_bytes(), max_size=(1024, 512))


@cache
def _phone_photograph() -> tuple[bytes, dict[str, str]]:
    """Return a photograph of 12 megapixels, and the fields of its query."""
    return phone_photograph(_living_room()), {"hfov_deg": f"{PHONE_FIELD_DEG:g}"}


@cache
def _turn() -> list[bytes]:
    """Return twelve photographs of a turn, of 1440 x 1080 pixels."""
    camera, sphere = Perspective.of_hfov(1080, 1440, math.radians(_FIELD_DEG)), _living_room()
    angles = 2.0 * math.pi * np.arange(_TURN) / _TURN
    return [encode_jpeg(cut_view(sphere, camera, azimuth=float(a), pitch=0.0, roll=0.0)) for a in angles]


@cache
def _film() -> bytes:
    """Return a film of 10 s in 1080p of a turn once around; needs FFmpeg."""
    camera, sphere = Perspective.of_hfov(540, 960, math.radians(_FIELD_DEG)), _living_room()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "turn.mp4"
        source = f"ffmpeg -v error -y -f rawvideo -pix_fmt rgb24 -s 540x960 -r {_FRAMES_PER_S} -i -"
        coded = "-vf fps=30,scale=1080:1920 -c:v libx264 -preset ultrafast -pix_fmt yuv420p -threads 1"
        command = [*source.split(), *coded.split(), str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            for index in range(_FRAMES):
                azimuth = 2.0 * math.pi * index / _FRAMES
                process.stdin.write(cut_view(sphere, camera, azimuth=azimuth, pitch=0.0, roll=0.0).tobytes())
            process.stdin.close()
        return path.read_bytes()


@cache
def _plan(name: str) -> bytes:
    """Return the example flat, or a generated office of 2,000 m²."""
    if name == "flat":
        return PLAN_PATH.read_bytes()
    return json.dumps(Building(VALIDATION, 3, _OFFICE_M2).plan.to_dict()).encode()


def _photograph(client: httpx.Client, checkout: Checkout) -> httpx.Response:
    content, fields = _phone_photograph()
    data = {"floorplan_id": checkout.service.plan_id, **fields}
    return client.post("/localise", data=data, files={"photo": ("p.jpg", content, "image/jpeg")})


def _sequence(client: httpx.Client, checkout: Checkout, name: str, contents: Sequence[bytes]) -> httpx.Response:
    data = {"floorplan_id": checkout.service.plan_id, "motion": "turn", "hfov_deg": "53"}
    return client.post("/localise/sequence", data=data, files=[(name, ("p", content)) for content in contents])


def _spheres(*, known: bool) -> Callable[[Checkout], Spent]:
    """Return the measurement of the example photographs, with or without their headings."""
    numbers = itertools.count()
    return _sent(lambda client, checkout: checkout.ask(client, next(numbers), known=known), _SINGLE)


def _spread(checkout: Checkout) -> Spent:
    """Return the 99th percentile of four clients over the median of one, in place of a duration."""
    one, four = (checkout.burst(clients)[1] for clients in (1, 4))
    return Spent(float(np.quantile(four, 0.99) / np.median(one)), float("nan"))


def _localisability(name: str) -> Callable[[Checkout], Spent]:
    """Return the measurement of the first request for a new plan."""

    def measure(checkout: Checkout) -> Spent:
        with httpx.Client(base_url=checkout.service.url, timeout=_TIMEOUT_S) as client:
            stored = client.post("/floorplans", files={"file": (f"{name}.json", _plan(name))})
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
    "sphere, heading known": _spheres(known=True),
    "sphere, heading unknown": _spheres(known=False),
    "four clients, per answer": lambda checkout: checkout.burst(4)[0],
    "p99 of four over p50 of one": _spread,
    "turn of twelve photographs": _sent(lambda client, checkout: _sequence(client, checkout, "photo", _turn())),
    "film of 10 s, 1080p": _sent(lambda client, checkout: _sequence(client, checkout, "film", [_film()])),
    "localisability, example flat": _localisability("flat"),
    "localisability, office of 2,000 m²": _localisability("office"),
    "lalaloc --help": _command("--help"),
    "lalaloc localise": _command("localise", str(PLAN_PATH), str(read_poses()[0].picture), "--json"),
    "service, start to ready": _start,
}


def _print_figures(
    checkouts: Sequence[Checkout], rounds: int, names: Sequence[str]
) -> dict[str, dict[str, float | None]]:
    """Print and return medians of figures over rounds in which the checkouts take turns, after a round as a warm-up.

    Ratios are medians of the ratios within a round.
    """
    before, after = (checkout.name for checkout in checkouts)
    harness.print_table_head("figure", before, after, "ratio", f"CPU, {before}", f"CPU, {after}", "ratio")
    figures: dict[str, dict[str, float | None]] = {}
    for name in names:
        if name.startswith("film") and shutil.which("ffmpeg") is None:
            print(harness.table_row(name, *["needs FFmpeg"] * 2, *[""] * 4), flush=True)
            continue
        found: list[list[Spent]] = []
        for index in range(rounds + 1):
            spent = {checkout.name: _measured(name, checkout) for checkout in checkouts[:: 1 if index % 2 else -1]}
            found.append([spent[before], spent[after]])
        values = np.array(found[1:])
        medians, ratios = np.median(values, axis=0), np.median(values[:, 1] / values[:, 0], axis=0)
        unit = "{:.2f}" if "over" in name else "{:.3f} s"
        cells: list[str] = []
        for kind, ratio in enumerate(ratios):
            texts = [*map(unit.format, medians[:, kind]), f"{ratio:.2f}"]
            cells += ["-" if "nan" in text else text for text in texts]
        print(harness.table_row(name, *cells), flush=True)
        wall, cpu = (None if np.isnan(ratio) else round(float(ratio), 2) for ratio in ratios)
        figures[name] = {"after": round(float(medians[1, 0]), 3), "ratio": wall, "cpu_ratio": cpu}
    return figures


def _measured(name: str, checkout: Checkout) -> Spent:
    try:
        return FIGURES[name](checkout)
    except httpx.HTTPStatusError:  # an old checkout may lack a kind of query
        return Spent(math.nan, math.nan)


def _differences(before: Checkout, after: Checkout) -> dict[str, float]:
    """Return the largest absolute differences of the answers to equal queries that both answered."""
    largest: dict[str, float] = {"position (m)": 0.0, "heading (°)": 0.0, "confidence": 0.0}
    for key in before.answers.keys() & after.answers.keys():
        old, new = before.answers[key], after.answers[key]
        turned = (new["heading_deg"] - old["heading_deg"] + 180.0) % 360.0 - 180.0
        moved = max(abs(new["position"][axis] - old["position"][axis]) for axis in ("x_m", "y_m"))
        found = moved, abs(turned), abs((new["confidence"] or 0.0) - (old["confidence"] or 0.0))
        largest = {name: max(value, part) for (name, value), part in zip(largest.items(), found, strict=True)}
    return largest


if __name__ == "__main__":
    sys.exit(main())
