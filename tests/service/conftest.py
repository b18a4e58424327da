"""Fixtures of the service's tests: the production app on a real bundle, and data to send to it."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import cache
from itertools import cycle
from multiprocessing import forkserver
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Literal

import httpx
import numpy as np
import pytest
import uvicorn
from fastapi import FastAPI

from lalaloc_core.bundle import Bundle, default_bundle
from service.app import create_app
from service.pools import supervisor
from service.pools.supervisor import Watchdog
from service.settings import CONSTANTS, Settings
from service.storage.statements import CHUNK_BYTES
from service.storage.store import Store
from tests.core.taken import EXAMPLES
from tests.painted import picture_file
from tests.service.postgres import PostgresServer, postgres_programs, postgres_server
from tests.service.ray_cluster import ray_cluster, serving

FLAT: dict[str, Any] = {
    "name": "Flat 3",
    "ceiling_height_m": 2.5,
    "camera_height_m": 1.5,
    "rooms": [
        {"name": "kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.4},
        {"name": "living room", "polygon": [[4, 0], [9, 0], [9, 6], [6, 6], [6, 3], [4, 3]]},
    ],
}

# Large enough that its grid is still in preparation when a test looks.
HALL = {"ceiling_height_m": 3.0, "rooms": [{"name": "hall", "polygon": [[0, 0], [40, 0], [40, 40], [0, 40]]}]}

# The flat of the example photographs.
HOME: dict[str, Any] = json.loads((EXAMPLES / "flat.json").read_text())

_DATABASE = os.environ.get("TEST_DATABASE", "sqlite")
_REPLICAS = 2 if _DATABASE == "replicas" else 1

# From an app's data folder to the address of its database.
DatabaseOf = Callable[[Path], str]
OpenStore = Callable[[], Store]
StartApp = Callable[..., AbstractContextManager[httpx.Client]]


@pytest.fixture(autouse=True)
def _clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.upper().startswith("LALALOC_"):
            monkeypatch.delenv(name)


@pytest.fixture(autouse=True)
def _skip_per_replica_tests(request: pytest.FixtureRequest) -> None:
    if (_REPLICAS > 1 or _DATABASE == "ray") and request.node.get_closest_marker("one_replica") is not None:
        pytest.skip("tests state of a single replica")


@pytest.fixture(scope="session", autouse=True)
def _forked_workers() -> Iterator[None]:
    """Fork workers from a process that has imported what they need, which takes longer than most tests.

    The service spawns them, as tests do that start it as a process of its own.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pytest", "tests.service.preloaded"])
    with pytest.MonkeyPatch.context() as patch:
        # As converters set it before their libraries are read.
        patch.setenv("OPENCV_FOR_THREADS_NUM", "1")
        forkserver.ensure_running()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(supervisor, "_START_METHOD", "forkserver")
        yield


@pytest.fixture(scope="session")
def sphere() -> bytes:
    """Return a valid sphere without content: smooth colours, 512 x 256."""
    return encode_picture(512, 256, "JPEG")


@pytest.fixture(scope="session")
def bundle(tiny_bundle: Path) -> Bundle:
    return Bundle.open(tiny_bundle)


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    programs = postgres_programs()
    if programs is None:
        pytest.skip("PostgreSQL is not installed; on Debian and Ubuntu the package is postgresql")
    with postgres_server(programs) as server:
        yield server


@pytest.fixture(scope="session")
def database_of(request: pytest.FixtureRequest) -> DatabaseOf:
    """Database of an app by its data folder: SQLite, or PostgreSQL with TEST_DATABASE=postgresql.

    With TEST_DATABASE=replicas, two apps use the same PostgreSQL database, and take turns in answering. With
    TEST_DATABASE=ray, the app runs on Ray, on PostgreSQL as well.
    """
    if _DATABASE == "sqlite":
        return lambda data_dir: f"sqlite:///{data_dir / 'lalaloc.sqlite3'}"
    server = request.getfixturevalue("postgres")
    return cache(lambda _data_dir: server.new_database())


@pytest.fixture(scope="session")
def ray_address() -> Iterator[str]:
    """Address of the app on Ray, see `serving`."""
    with ray_cluster() as address:
        yield address


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SQLite database without content, to be copied: all migrations take as long as the rest of a start."""
    path = tmp_path_factory.mktemp("database") / "lalaloc.sqlite3"
    Store(f"sqlite:///{path}").close()
    return path


@pytest.fixture(scope="session")
def start_app(
    request: pytest.FixtureRequest, tiny_bundle: Path, database_of: DatabaseOf, empty_database: Path
) -> StartApp:
    """Start the production app in this process, by default without LPO workers."""
    # The imports of all workers are done before any request has a time limit.
    first = multiprocessing.get_context("forkserver").Process(target=int)
    first.start()
    first.join()

    @contextmanager
    def start(data_dir: Path, **overrides: Any) -> Iterator[httpx.Client]:
        if not (url := database_of(data_dir)).startswith("sqlite"):
            overrides = {"database_url": url} | overrides
        elif "database_url" not in overrides and not (data_dir / empty_database.name).exists():
            data_dir.mkdir(parents=True, exist_ok=True)
            shutil.copy(empty_database, data_dir)
        values = {"data_dir": data_dir, "bundle": tiny_bundle, "workers": 0, "onnx_threads": 1, "log_level": "error"}
        values |= {"decode_workers": 1, "import_workers": 1}
        values |= overrides
        settings = Settings(**{name: value for name, value in values.items() if name not in CONSTANTS})
        with ExitStack() as stack:
            stack.enter_context(constants({name: value for name, value in values.items() if name in CONSTANTS}))
            if _DATABASE == "ray":
                address = request.getfixturevalue("ray_address")
                stack.enter_context(serving(settings))
                yield stack.enter_context(httpx.Client(base_url=address, timeout=60.0))
                return
            urls = [stack.enter_context(serve(create_app(settings))) for _ in range(_REPLICAS)]
            turns = InTurn(urls) if _REPLICAS > 1 else None
            yield stack.enter_context(httpx.Client(base_url=urls[0], timeout=120.0, transport=turns))

    return start


class InTurn(httpx.BaseTransport):
    """Sends one request to the first of some addresses, the next one to the second, and so on."""

    def __init__(self, urls: Sequence[str]) -> None:
        self._urls = cycle([httpx.URL(url) for url in urls])
        self._transport = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        url = next(self._urls)
        request.url = request.url.copy_with(host=url.host, port=url.port)
        return self._transport.handle_request(request)

    def close(self) -> None:
        self._transport.close()


@pytest.fixture(scope="module")
def app_settings(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the `APP_SETTINGS` of a module, which may name the fixture of its bundle."""
    settings: dict[str, Any] = getattr(request.module, "APP_SETTINGS", {})
    bundle = settings.get("bundle")
    return settings | ({"bundle": request.getfixturevalue(bundle)} if isinstance(bundle, str) else {})


@pytest.fixture(scope="module")
def client(
    start_app: StartApp, app_settings: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[httpx.Client]:
    """Yield one app for the tests of a module, which do not disturb each other."""
    with start_app(tmp_path_factory.mktemp("data"), **app_settings) as started:
        yield started


@pytest.fixture(scope="module")
def flat(client: httpx.Client) -> str:
    """Return the id of `FLAT` in the app of a module."""
    return upload(client)


@pytest.fixture(scope="module")
def shipped(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Yield an app with the shipped model and a ready worker."""
    deadlines = {"lpo_deadline_s": 60.0, "lpo_stall_s": 60.0, "request_deadline_s": 90.0}
    with start_app(tmp_path_factory.mktemp("shipped"), bundle=default_bundle(), workers=1, **deadlines) as started:
        wait_for(lambda: started.get("/readyz").status_code == 200, 120.0)
        yield started


@pytest.fixture(scope="module")
def home(shipped: httpx.Client) -> str:
    """Return the id of the example flat in the app with the shipped model."""
    return upload(shipped, HOME)


# A schema takes PostgreSQL longer than most tests, so those of both kinds run on it before a release; replicas,
# backups and keys are tested on it always.
@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def url(request: pytest.FixtureRequest, tmp_path: Path, empty_database: Path) -> str:
    """Return the URL of an empty database of either kind."""
    if request.param == "sqlite":
        return f"sqlite:///{shutil.copy(empty_database, tmp_path)}"
    return request.getfixturevalue("postgres").new_database()


@pytest.fixture
def configured_url(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the URL of an empty database of either kind, which the settings in the environment name."""
    monkeypatch.setenv("LALALOC_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("LALALOC_DATABASE_URL", url)
    return url


@pytest.fixture
def open_store(url: str) -> Iterator[OpenStore]:
    """Return a function that opens a database of either kind again, as another process does."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(closing(Store(url, wait_s=60.0)))


@pytest.fixture
def store(tmp_path: Path, empty_database: Path) -> Iterator[Store]:
    """Yield an empty store on SQLite."""
    with closing(Store(f"sqlite:///{shutil.copy(empty_database, tmp_path / 'test.sqlite3')}")) as opened:
        yield opened


@pytest.fixture
def app_store(database_of: DatabaseOf, empty_database: Path, tmp_path: Path) -> Iterator[Store]:
    """Yield the store of the app whose data folder is `tmp_path`."""
    url = database_of(tmp_path)
    if url.startswith("sqlite"):
        shutil.copy(empty_database, tmp_path)
    with closing(Store(url)) as opened:
        yield opened


@contextmanager
def constants(values: Mapping[str, Any]) -> Iterator[None]:
    """Give constants that stand beside the settings other values."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            group, attribute = CONSTANTS[name]
            patch.setattr(type(Settings.model_fields[group].default), attribute, value)
        yield


@contextmanager
def serve(app: FastAPI) -> Iterator[str]:
    """Run an app on a real server, on a thread and a free port; gives its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        # Connections inherit it; without, answers wait 40 ms for their heads to be acknowledged.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        server = uvicorn.Server(uvicorn.Config(app, loop="asyncio", log_level="critical"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: server.started or not thread.is_alive())
            assert server.started, "the app did not start"
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(30.0)
            assert not thread.is_alive(), "the app did not stop"


@cache
def encode_picture(width: int, height: int, picture_format: str, **options: Any) -> bytes:
    """Return a smooth picture as encoded bytes."""
    x, y = np.meshgrid(np.linspace(0.0, 6.28, width), np.linspace(0.0, 3.14, height))
    channels = [127.0 + 120.0 * np.sin(x + phase) * np.sin(y) for phase in (0.0, 2.0, 4.0)]
    return picture_file(np.stack(channels, axis=-1).astype(np.uint8), picture_format, **options)


def tiled_plan(side: int, *, openings: bool = False) -> dict[str, Any]:
    """Return a plan of `side` x `side` square rooms, each with a door and a window if `openings`."""
    corners = [(4.0 * i, 4.0 * j) for j in range(side) for i in range(side)]
    rooms = [{"polygon": [[x, y], [x + 4, y], [x + 4, y + 4], [x, y + 4]]} for x, y in corners]
    doors = [{"kind": "door", "line": [[x + 1, y], [x + 2, y]]} for x, y in corners if openings]
    windows = [{"kind": "window", "line": [[x, y + 1], [x, y + 2]]} for x, y in corners if openings]
    return {"name": "tiles", "ceiling_height_m": 2.5, "rooms": rooms, "openings": doors + windows}


def upload(client: httpx.Client, plan: dict[str, Any] | None = None, *, wait: bool = True) -> str:
    """Upload a plan, wait until it is ready, return its id."""
    plan_id = document_of(client.post("/floorplans", json=plan or FLAT), 201)["id"]
    if wait:
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
    return plan_id


def original_of(store: Store, plan_id: str) -> bytes:
    """Return the uploaded file of a plan's current revision, regardless of tenant."""
    (summary,) = store.plans.summaries([plan_id])
    file = store.originals.checked(summary.revision_id)
    assert file is not None
    content = b""
    while len(content) < file[1]:
        chunk = store.originals.chunk(summary.revision_id, len(content) // CHUNK_BYTES)
        assert chunk
        content += chunk
    return content


def document_of(response: httpx.Response, status: int = 200) -> Any:
    """Check the status of an answer, and return its document."""
    assert response.status_code == status, response.text
    return response.json()


def pages(client: httpx.Client, path: str, **query: Any) -> Iterator[dict[str, Any]]:
    """Yield the pages of a list, each by the cursor of the one before."""
    while True:
        page = document_of(client.get(path, params=query))
        yield page
        if page["next_cursor"] is None:
            return
        query["cursor"] = page["next_cursor"]


def lines_of(response: httpx.Response) -> list[dict[str, Any]]:
    """Check that an answer has a JSON document per line, and return these."""
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/x-ndjson"
    return [json.loads(line) for line in response.text.splitlines()]


def connection_to(client: httpx.Client) -> socket.socket:
    """Return a connection to the service of a client, for what a client does not send."""
    return socket.create_connection((client.base_url.host, client.base_url.port or 80), timeout=60.0)


def localise(client: httpx.Client, plan_id: str, picture: bytes, **fields: Any) -> httpx.Response:
    data = {"floorplan_id": plan_id} | {name: str(value) for name, value in fields.items()}
    return client.post("/localise", data=data, files={"photo": ("p.jpg", picture, "image/jpeg")})


def localise_turn(client: httpx.Client, plan_id: str, *pictures: bytes, **fields: Any) -> httpx.Response:
    data = {"floorplan_id": plan_id, "motion": "turn"} | {name: str(value) for name, value in fields.items()}
    files = [("photo", ("p.jpg", picture, "image/jpeg")) for picture in pictures]
    return client.post("/localise/sequence", data=data, files=files)


def wait_for(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = monotonic() + timeout_s
    while not condition():
        assert monotonic() < deadline, "timed out waiting"
        sleep(0.05)


def metric(client: httpx.Client, sample: str) -> float:
    """Return the value of a sample of /metrics; 0 for a labelled one that has not occurred yet."""
    match = re.search(rf"^{re.escape(sample)} (\S+)$", client.get("/metrics").text, re.MULTILINE)
    assert match or "{" in sample, f"there is no metric {sample}"
    return float(match[1]) if match else 0.0


def end_time_limits(verdict: Literal["stalled", "stopped"] = "stalled") -> int:
    """Let the time limits of all running jobs and starts of this process's pools pass; return their number."""
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    watchdogs = [getattr(timer.function, "__self__", None) for timer in timers if not timer.finished.is_set()]
    running = [watchdog for watchdog in watchdogs if isinstance(watchdog, Watchdog)]
    for watchdog in running:
        watchdog.expire(verdict)
    return len(running)


def assert_problem(response: httpx.Response, status: int, slug: str) -> dict[str, Any]:
    """Check that an answer is a complete problem document and return it."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["type"] == f"urn:lalaloc:problem:{slug}"
    assert problem["status"] == status
    assert problem["title"]
    assert problem["detail"]
    assert problem["request_id"] == response.headers["x-request-id"]
    assert "Traceback" not in response.text
    return problem
