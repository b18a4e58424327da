"""The service as users run it: `uvicorn service.app:app` in a process of its own."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import ssl
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep

import httpx
import pytest

from service.cli.entry_point import store_example
from service.cli.lan_access import lan_address, lan_certificate
from service.settings import CONSTANTS, PREFIX, Settings
from service.storage import open_store
from tests.local_servers import free_port
from tests.service.conftest import localise, upload, wait_for
from tests.service.test_localise import HALL

ROOT = Path(__file__).parents[2]


def environment_of(bundle: Path, data_dir: Path, **settings: str) -> dict[str, str]:
    """Return the environment of a service with these settings, or constants beside them, only."""
    given = {"BUNDLE": str(bundle), "DATA_DIR": str(data_dir), "ONNX_THREADS": "1"} | settings
    changed = {name: float(given.pop(name.upper())) for name in CONSTANTS if name.upper() in given}
    clean = {name: value for name, value in os.environ.items() if not name.upper().startswith(PREFIX)}
    constants = f"{os.pathsep}{ROOT / 'tests' / 'service' / 'with_constants'}" if changed else ""
    own = {"PYTHONPATH": f"{ROOT}{constants}", "TEST_CONSTANTS": json.dumps(changed)}
    return clean | {PREFIX + name: value for name, value in given.items()} | own


@contextmanager
def _uvicorn(environment: dict[str, str], log: Path) -> Iterator[tuple[subprocess.Popen[bytes], httpx.Client]]:
    """Run the service; whoever uses it ends it, and it is killed if they did not."""
    port = free_port()
    command = [sys.executable, "-m", "uvicorn", "service.app:app", "--port", str(port)]
    with log.open("ab") as output:
        process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=output, stderr=output)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as client:
            wait_for(lambda: process.poll() is not None or is_up(client), 120.0)
            assert process.poll() is None, log.read_text()
            yield process, client
    finally:
        if process.poll() is None:
            process.kill()
        process.wait(10.0)


def is_up(client: httpx.Client, status: int = 200) -> bool:
    """Return True if something listens, and tells health with a status."""
    try:
        return client.get("/healthz").status_code == status
    except httpx.TransportError:
        return False


def children(pid: int) -> list[int]:
    listing = subprocess.run(
        ["ps", "-ww", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split(maxsplit=2) for line in listing.splitlines()]
    return [int(row[0]) for row in rows if int(row[1]) == pid and "spawn_main" in row[2]]


def alive(pid: int) -> bool:
    """Return True if a process runs; zombies do not."""
    listing = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(listing.strip()) and not listing.strip().startswith("Z")


def _warm(client: httpx.Client) -> bool:
    return client.get("/readyz").json()["lpo_pool"]["ready"] > 0


@pytest.mark.slow
def test_plans_and_grids_survive_a_restart(tiny_bundle: Path, tmp_path: Path, sphere: bytes) -> None:
    environment = environment_of(tiny_bundle, tmp_path / "data", LPO_DEADLINE_S="9")
    with _uvicorn(environment, tmp_path / "log") as (process, client):
        early = client.get("/readyz")
        assert early.status_code == (200 if early.json()["ready"] else 503)
        wait_for(lambda: client.get("/readyz").status_code == 200, 120.0)
        plan_id = upload(client)
        before = localise(client, plan_id, sphere).json()
        assert before["stage"] == "lpo"
        assert before["timings_ms"]["lpo"] > 0.0
        coarse = localise(client, plan_id, sphere, refine="none").json()
        workers = children(process.pid)
        assert workers
        process.send_signal(signal.SIGTERM)
        # Some versions of uvicorn end by the signal itself, once they have shut down in order.
        assert process.wait(20.0) in (0, -signal.SIGTERM)
        assert "Application shutdown complete" in (tmp_path / "log").read_text()
        assert not any(alive(worker) for worker in workers)
    with _uvicorn(environment | {"LALALOC_WORKERS": "0"}, tmp_path / "log") as (process, client):
        # Ready at once: the grid was read, not computed.
        assert client.get(f"/floorplans/{plan_id}").json()["status"] == "ready"
        assert "lalaloc_grid_seconds_count 0.0" in client.get("/metrics").text
        assert localise(client, plan_id, sphere, refine="none").json()["candidates"] == coarse["candidates"]


@pytest.mark.slow
def test_killed_workers_cost_no_answers(tiny_bundle: Path, tmp_path: Path, sphere: bytes) -> None:
    rng = random.Random(3)
    environment = environment_of(tiny_bundle, tmp_path / "data", WORKERS="2", MAX_QUERIES="8")
    with _uvicorn(environment, tmp_path / "log") as (process, client):
        wait_for(lambda: client.get("/readyz").status_code == 200, 120.0)
        plan_id = upload(client)
        end = monotonic() + 10.0

        def ask_until_the_end() -> list[httpx.Response]:
            answers = []
            while monotonic() < end:
                answers.append(localise(client, plan_id, sphere, refine="lpo"))
            return answers

        with ThreadPoolExecutor(4) as threads:
            clients = [threads.submit(ask_until_the_end) for _ in range(4)]
            while monotonic() < end:
                # Mostly one, now and then all, and at any stage of their lives.
                workers = children(process.pid)
                for worker in rng.sample(workers, len(workers) if rng.random() < 0.2 else 1) if workers else []:
                    with suppress(ProcessLookupError):
                        os.kill(worker, signal.SIGKILL)
                sleep(rng.uniform(0.2, 1.5))
            answers = [answer for asking in clients for answer in asking.result()]
        assert {answer.status_code for answer in answers} == {200}
        assert {answer.json()["stage"] for answer in answers} <= {"lpo", "vdr"}
        wait_for(lambda: _warm(client), 120.0)
        assert localise(client, plan_id, sphere).json()["stage"] == "lpo"
        assert 'lalaloc_pool_restarts_total{pool="lpo"} 0.0' not in client.get("/metrics").text


@pytest.mark.slow
def test_killed_service_leaves_no_workers_and_resumes(tiny_bundle: Path, tmp_path: Path) -> None:
    environment = environment_of(tiny_bundle, tmp_path / "data")
    with _uvicorn(environment, tmp_path / "log") as (process, client):
        wait_for(lambda: _warm(client), 120.0)
        workers = children(process.pid)
        plan_id = upload(client, HALL, wait=False)
        assert client.get(f"/floorplans/{plan_id}").json()["status"] == "preparing"
        # Not even one that cannot notice anything by itself outlives the service.
        os.kill(workers[0], signal.SIGSTOP)
        process.kill()
        process.wait(10.0)
        wait_for(lambda: not any(alive(worker) for worker in workers))
    with _uvicorn(environment | {"LALALOC_WORKERS": "0"}, tmp_path / "log") as (process, client):
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        # A service that is preparing when it is told to stop does so without finishing first.
        upload(client, HALL, wait=False)
        process.send_signal(signal.SIGINT)
        process.wait(10.0)
    assert (tmp_path / "log").read_text().count("Application shutdown complete") == 1


@pytest.mark.slow
def test_service_process_never_loads_torch(tiny_bundle: Path, tmp_path: Path) -> None:
    script = [sys.executable, "-m", "tests.service.torch_free", str(tiny_bundle), str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if not name.upper().startswith(PREFIX)}
    done = subprocess.run(script, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["stage"] == "lpo"
    assert "onnxruntime" in report["modules"]
    assert not {"torch", "safetensors", "matplotlib", "onnx"} & set(report["modules"])


def test_damaged_model_stops_the_start(tiny_bundle: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "model"
    shutil.copytree(tiny_bundle, damaged)
    network = damaged / "image_encoder.onnx"
    content = bytearray(network.read_bytes())
    content[len(content) // 2] ^= 1
    network.write_bytes(content)
    environment = environment_of(damaged, tmp_path / "data")
    command = [sys.executable, "-m", "service", "--port", "0"]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert "'image_encoder.onnx'" in done.stderr
    assert "the manifest states" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(lan_address() is None, reason="this machine is in no network")
def test_link_for_phones_has_a_key_that_ends_with_the_run(tiny_bundle: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "service", "--port", "0", "--example", "--lan"]
    environment = environment_of(tiny_bundle, tmp_path, WORKERS="0")
    process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url, _, key = process.stdout.readline().strip().partition("/#key=")
        context = ssl.create_default_context(cafile=str(next(tmp_path.glob("lan-certificate-*.pem"))))
        with httpx.Client(base_url=url, verify=context, timeout=120.0, trust_env=False) as client:
            assert client.get("/floorplans").status_code == 401
            client.headers["Authorization"] = f"Bearer {key}"
            assert client.get("/floorplans").json()["floorplans"][0]["name"] == "Example flat"
    finally:
        process.terminate()
        process.wait(30.0)
    with closing(open_store(Settings(data_dir=tmp_path))) as store:
        assert [run.revoked_at is None for run in store.keys.list_keys()] == [False]


def test_example_is_stored_in_an_empty_database_only(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with closing(open_store(settings)) as store:
        assert [store_example(store, settings) for _ in range(2)] == ["Example flat", None]
        assert [plan.name for plan in store.plans.list_plans("default", limit=9)] == ["Example flat"]


def test_certificate_is_kept_until_it_is_old(tmp_path: Path) -> None:
    path = lan_certificate(tmp_path, "192.0.2.7")
    assert path.stat().st_mode & 0o777 == 0o600
    first = path.read_bytes()
    assert lan_certificate(tmp_path, "192.0.2.7").read_bytes() == first
    os.utime(path, (0.0, 0.0))
    assert lan_certificate(tmp_path, "192.0.2.7").read_bytes() != first


@pytest.mark.slow
def test_log_is_json_and_holds_no_query(tiny_bundle: Path, tmp_path: Path) -> None:
    environment = environment_of(tiny_bundle, tmp_path / "data", WORKERS="0")
    with _uvicorn(environment, tmp_path / "log") as (process, client):
        client.get("/floorplans", params={"name": "very-secret"}, headers={"authorization": "Bearer very-secret"})
        # The parser of forms has words of its own for this.
        form = {"content-type": "multipart/form-data; boundary=b"}
        assert client.post("/floorplans", content=b"--b\r\nvery\rsecret: 1\r\n\r\n", headers=form).status_code == 400
        process.send_signal(signal.SIGINT)
        process.wait(20.0)
    text = (tmp_path / "log").read_text()
    assert "very-secret" not in text
    # The server says two lines of its own before it starts the application.
    lines = [json.loads(line) for line in text.splitlines() if "INFO: " not in line]
    assert all(line.keys() >= {"time", "level", "message", "request_id", "trace_id"} for line in lines)
    assert [line["route"] for line in lines if line["message"] == "request"][-2:] == ["/floorplans"] * 2
    assert len(text.splitlines()) - len(lines) <= 2
