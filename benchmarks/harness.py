"""Set-up that benchmarks share: the service with the example plan, clients of load tests, CPU time and memory."""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import math
import multiprocessing
import random
import socket
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from email.message import Message
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import psutil

from examples.launch import ROOT, running_service
from examples.truth import PLAN_PATH, TruePose, read_poses

_JSON = "application/json"
_REQUEST_TIMEOUT_S, _PLAN_TIMEOUT_S, _IDLE_S = 600.0, 120.0, 5.0
_SMALL_BUFFER = 4096
_REFUSED = "refused"
_STAGES = ("lpo", "vdr")
# A position error above this is a wrong answer: the example photographs are located to a few centimetres.
_MAX_ERROR_M = 0.5
# Settings under which no request of a throughput test is refused.
UNLIMITED = {"LALALOC_MAX_QUERIES": "64"}


def argument_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that shows a module's docstring as it is written."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def print_table_head(*names: str) -> None:
    print(table_head(*names), flush=True)


def table_head(*names: str) -> str:
    return f"{table_row(*names)}\n|{'---|' * len(names)}"


def table_row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


@dataclass(frozen=True)
class Service:
    """Running service that is ready, the server's process, its data folder, and the example plan if it is stored."""

    url: str
    process: psutil.Process
    data: Path
    plan_id: str = ""


@contextmanager
def started_service(data: Path, settings: Mapping[str, str] | None = None, checkout: Path = ROOT) -> Iterator[Service]:
    """Run the service of a checkout in one process, with a data folder."""
    # The folder's own packages come before installed ones.
    environment = {"LALALOC_DATA_DIR": str(data), "LALALOC_LOG_LEVEL": "error", "PYTHONPATH": str(checkout)}
    with running_service(0, environment | dict(settings or {}), checkout) as started:
        yield Service(started.url, psutil.Process(started.process.pid), data)


@contextmanager
def example_service(settings: Mapping[str, str] | None = None, checkout: Path = ROOT) -> Iterator[Service]:
    """Run the service in one process, with the example plan and a temporary data folder."""
    with tempfile.TemporaryDirectory() as data, started_service(Path(data), settings, checkout) as service:
        yield replace(service, plan_id=upload_example_plan(service.url))


def wait_until(is_true: Callable[[], bool], condition: str, timeout_s: float, pause_s: float = 0.05) -> None:
    deadline = time.monotonic() + timeout_s
    while not is_true():
        if time.monotonic() > deadline:
            raise TimeoutError(f"it does not hold after {timeout_s:g} s that {condition}")
        time.sleep(pause_s)


def upload_example_plan(url: str) -> str:
    """Store the example plan, wait until it is ready, and return its id."""
    with httpx.Client(base_url=url, timeout=60.0) as client:
        response = client.post("/floorplans", files={"file": (PLAN_PATH.name, PLAN_PATH.read_bytes())})
        plan_id: str = response.raise_for_status().json()["id"]
        path = f"/floorplans/{plan_id}"
        wait_until(lambda: client.get(path).json()["status"] == "ready", "the example plan is ready", _PLAN_TIMEOUT_S)
    return plan_id


def query_of(pose: TruePose, **target: str) -> dict[str, Any]:
    """Return the form of a query with an example photograph and its heading, as arguments of `httpx.post`."""
    fields = {**target, "heading_deg": f"{pose.heading_deg}", "camera_height_m": f"{pose.camera_height_m}"}
    return {"data": fields, "files": {"photo": (pose.file, pose.picture.read_bytes())}}


@dataclass(frozen=True)
class Answer:
    """Answer to a request; status 0 is a broken connection."""

    status: int
    content: bytes = b""
    headers: Mapping[str, str] | Message = field(default_factory=dict)

    @property
    def etag(self) -> str:
        return self.headers.get("ETag", "")

    def json(self) -> Any:
        return json.loads(self.content)


class Caller:
    """One persistent connection of a tenant; `count` is called with the status of every answer."""

    def __init__(self, url: str, key: str | None = None, count: Callable[[int], None] = lambda _status: None) -> None:
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=_REQUEST_TIMEOUT_S)
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._count = count
        self._used_at = time.monotonic()

    def send(self, method: str, path: str, content: bytes = b"", media: str = _JSON, etag: str = "") -> Answer:
        """Send a request and read its answer; `etag` makes it conditional."""
        headers = dict(self._headers)
        headers |= ({"Content-Type": media} if content else {}) | ({"If-None-Match": etag} if etag else {})
        if time.monotonic() - self._used_at > _IDLE_S:
            # The service may have closed the idle connection; this opens a new one.
            self._connection.close()
        try:
            self._connection.request(method, path, content, headers)
            response = self._connection.getresponse()
            answer = Answer(response.status, response.read(), response.headers)
        except (http.client.HTTPException, OSError):
            # The service answers and closes while a refused body is still sent.
            self._connection.close()
            answer = Answer(0)
        self._used_at = time.monotonic()
        self._count(answer.status)
        return answer

    def send_bytes(self, head: str, content: bytes = b"", hold_s: float = 0.0) -> Answer:
        """Send a completed head and bytes on a connection of its own; read only the status, and wait for `hold_s`."""
        lines = [head, f"Host: {self._connection.host}", *(f"{name}: {value}" for name, value in self._headers.items())]
        answer = b""
        with suppress(OSError), socket.socket() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SMALL_BUFFER)
            connection.settimeout(_REQUEST_TIMEOUT_S)
            connection.connect((self._connection.host, self._connection.port))
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            # The service may answer and close before everything is sent.
            with suppress(ConnectionError):
                connection.sendall(content)
            while b"\r\n" not in answer and (part := connection.recv(_SMALL_BUFFER)):
                answer += part
            time.sleep(hold_s)
        status = int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/") else 0
        self._count(status)
        return Answer(status)


class Rehearsal(Caller):
    """Caller that sends nothing: all connections are broken."""

    def send(self, *_arguments: Any, **_options: Any) -> Answer:
        return Answer(0)

    send_bytes = send


@cache
def form(fields: tuple[tuple[str, str], ...], files: tuple[tuple[str, bytes], ...]) -> tuple[bytes, str]:
    """Return a multipart body and its media type."""
    parts = [(name, (name, content)) for name, content in files]
    request = httpx.Request("POST", "http://localhost", data=dict(fields), files=parts)
    return request.read(), request.headers["Content-Type"]


def example_query(number: int, plan_id: str) -> tuple[bytes, str]:
    """Return the query with an example photograph, its heading and its camera height, as body and media type."""
    poses = read_poses()
    query = query_of(poses[number % len(poses)], floorplan_id=plan_id)
    return form(tuple(query["data"].items()), (("photo", query["files"]["photo"][1]),))


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the percentile of the nearest rank; NaN without values."""
    ordered = sorted(values)
    return ordered[max(math.ceil(percent / 100.0 * len(ordered)), 1) - 1] if ordered else math.nan


@dataclass(frozen=True)
class LoadResult:
    """Result of a load test: durations (ms) by stage of the answer, refusals with `Retry-After`, and failures."""

    durations_ms: Mapping[str, Sequence[float]]
    refused: int
    failures: int
    seconds: float


def run_load(url: str, plan_ids: Sequence[str], clients: int, seconds: float) -> LoadResult:
    """Localise the example photographs with several clients at once, and check the answers.

    The clients take the plans in turns and pause for about a second after a refusal. They run in a process of their
    own, whose clock no other thread delays.
    """
    with child_process(_send_load, url, plan_ids, clients, seconds) as pipe:
        return pipe.recv()


@contextmanager
def child_process(target: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    """Run a function in another process, with a pipe after its arguments; yield the other end, which ends with it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(*arguments, theirs), daemon=True)
    process.start()
    # The end of the process ends the waiting for its result.
    theirs.close()
    try:
        yield ours
    finally:
        process.kill()
        process.join()


def _send_load(url: str, plan_ids: Sequence[str], clients: int, seconds: float, pipe: Connection) -> None:
    durations_ms: dict[str, list[float]] = defaultdict(list)
    others: Counter[str] = Counter()
    poses = read_poses()
    queries = {plan_id: [example_query(number, plan_id) for number in range(len(poses))] for plan_id in plan_ids}
    end = time.monotonic() + seconds

    def repeat(client: int) -> None:
        caller = Caller(url)
        for number in itertools.count(client):
            if time.monotonic() > end:
                return
            begin = time.perf_counter()
            answer = caller.send("POST", "/localise", *queries[plan_ids[client % len(plan_ids)]][number % len(poses)])
            kind = _kind_of(answer, poses[number % len(poses)])
            if kind in _STAGES:
                durations_ms[kind].append(1e3 * (time.perf_counter() - begin))
            else:
                others[kind] += 1
            if kind == _REFUSED:
                time.sleep(random.uniform(0.5, 1.5))

    with ThreadPoolExecutor(clients) as threads:
        list(threads.map(repeat, range(clients)))
    refused = others.pop(_REFUSED, 0)
    for failure, count in others.items():
        print(f"{count} times: {failure}", file=sys.stderr)
    pipe.send(LoadResult(dict(durations_ms), refused, others.total(), seconds))


def _kind_of(answer: Answer, pose: TruePose) -> str:
    """Return the stage of an answer, "refused", or what is wrong."""
    if answer.status in (429, 503) and answer.headers.get("Retry-After", "").isdecimal():
        return _REFUSED
    if answer.status != httpx.codes.OK:
        return f"status {answer.status}: {answer.content[:200]!r}"
    document = answer.json()
    error_m = math.dist((document["position"]["x_m"], document["position"]["y_m"]), (pose.x_m, pose.y_m))
    stage: str = document["stage"]
    return stage if error_m <= _MAX_ERROR_M else f"{pose.file}: {error_m:.2f} m off at stage {stage}"


def cpu_s(process: psutil.Process) -> float:
    """Return the CPU time (s, user and system) of a service and its workers."""
    total_s = 0.0
    for part in (process, *process.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):
            total_s += sum(part.cpu_times()[:2])
    return total_s


class Stopwatch:
    """Wall clock and CPU time of a service and its workers since the stopwatch was made."""

    def __init__(self, process: psutil.Process) -> None:
        self._process, self._wall, self._cpu = process, time.perf_counter(), cpu_s(process)

    def times_s(self) -> tuple[float, float]:
        """Return the duration and the CPU time (s)."""
        wall_s = time.perf_counter() - self._wall
        return wall_s, cpu_s(self._process) - self._cpu


def resident_mb(process: psutil.Process) -> float:
    """Return the resident memory (MB) of a process; 0 when it has ended."""
    try:
        return process.memory_info().rss / 2**20
    except psutil.NoSuchProcess:
        return 0.0
