"""Queries with features instead of photographs, the model's files for devices, and what remains of photographs."""

from __future__ import annotations

import base64
import gzip
import json
import math
import os
import random
import shutil
import signal
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.bundle import OBJECTS_ONNX, VIEW_ONNX, Bundle, default_bundle
from lalaloc_core.localise.encode.features import DEVICE_FILES, MAX_BYTES, FeatureEncoder, read_features
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size, sphere_size
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.photograph import Photograph, open_photograph
from service.routes import model_files
from service.storage.store import Store
from tests.core.taken import EXAMPLES
from tests.service.conftest import HOME, StartApp, assert_problem, document_of, upload, wait_for
from tests.service.test_process import children
from tests.service.test_security import bearer, make_key
from tests.service.test_stopping import running_service
from tests.service.test_telemetry import collector
from tests.strategies import present

KITCHEN, PHONE = ((EXAMPLES / name).read_bytes() for name in ("kitchen.jpg", "phone.jpg"))
PREFIX = struct.Struct("<4sHI")
APP_SETTINGS = {"bundle": default_bundle(), "request_deadline_s": 90.0}


class Device:
    """A device that encodes photographs with the shipped model."""

    def __init__(self) -> None:
        self.bundle = Bundle.open(default_bundle())
        self._encoder = FeatureEncoder(self.bundle, threads=1)

    def view(self, photograph: bytes) -> Photograph:
        manifest = self.bundle.manifest
        return open_photograph(photograph, sphere_size=sphere_size(manifest), patch_size=patch_size(manifest))

    @cache  # noqa: B019, it lives as long as the module.
    def features(self, photograph: bytes) -> bytes:
        return self._encoder.features(self.view(photograph))


@pytest.fixture(scope="module")
def device() -> Device:
    return Device()


@pytest.fixture(scope="module")
def home(client: httpx.Client) -> str:
    return upload(client, HOME)


def ask(client: httpx.Client, name: str, *contents: bytes, path: str = "/localise", **fields: Any) -> httpx.Response:
    data = {key: str(value) for key, value in ({"refine": "none"} | fields).items()}
    return client.post(path, data=data, files=[(name, ("file", content)) for content in contents])


def same(first: Any, second: Any) -> bool:
    """Compare answers; numbers may differ by the rounding of one addition."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(
            same(first[key], second[key]) for key in first if key != "timings_ms"
        )
    if isinstance(first, list):
        return len(first) == len(second) and all(map(same, first, second))
    return first == (pytest.approx(second, rel=1e-3, abs=1e-3) if isinstance(second, float) else second)


@pytest.mark.parametrize("photograph", [KITCHEN, PHONE], ids=["sphere", "phone"])
def test_features_get_the_answer_of_their_photograph(
    client: httpx.Client, home: str, device: Device, photograph: bytes
) -> None:
    features = device.features(photograph)
    assert len(features) < 60_000
    by_photograph, by_features = (
        ask(client, name, content, floorplan_id=home, camera_height_m=1.6, refine="vdr")
        for name, content in (("photo", photograph), ("features", features))
    )
    assert same(document_of(by_features), by_photograph.json())


@pytest.mark.parametrize("height_m", [0.8, 1.3, 2.2])
def test_features_hold_for_any_camera_height(device: Device, height_m: float) -> None:
    view = device.view(KITCHEN)
    encoder, height = PhotographEncoder(device.bundle, threads=1), CameraHeight(height_m)
    expected = encoder.query(view, None, height)
    found = encoder.query(read_features(device.features(KITCHEN), device.bundle), None, height)
    np.testing.assert_allclose(found.latents, expected.latents, atol=1e-3)
    np.testing.assert_allclose(present(found.profile).log_m, present(expected.profile).log_m, atol=1e-4)


def test_known_heading_finds_the_place_of_the_photograph(client: httpx.Client, home: str, device: Device) -> None:
    # The photograph is turned before it is encoded, its features afterwards, by whole sectors.
    by_photograph, by_features = (
        ask(client, name, content, floorplan_id=home, heading_deg=252.0, refine="vdr").json()
        for name, content in (("photo", KITCHEN), ("features", device.features(KITCHEN)))
    )
    places = [(answer["position"]["x_m"], answer["position"]["y_m"]) for answer in (by_photograph, by_features)]
    assert math.dist(*places) < 0.3
    assert by_features["heading_deg"] == by_photograph["heading_deg"] == 252.0


@pytest.mark.slow
def test_sequences_venues_and_sessions_take_features(client: httpx.Client, home: str, device: Device) -> None:
    features = [device.features(photograph) for photograph in (KITCHEN, PHONE)]
    answers = [
        ask(client, name, *contents, path="/localise/sequence", floorplan_id=home, motion="turn").json()
        for name, contents in (("photo", (KITCHEN, PHONE)), ("features", features))
    ]
    assert same(*answers)
    turns = {"path": "/localise/sequence", "floorplan_id": home, "motion": "turn", "relative_heading_deg": "[0, 60]"}
    answers = [
        ask(client, name, content, content, **turns).json()
        for name, content in (("photo", PHONE), ("features", features[1]))
    ]
    assert same(*answers)
    venue = client.post("/venues", json={"plans": [{"floorplan_id": home, "level": 0}]}).json()["id"]
    found = ask(client, "features", features[0], venue_id=venue)
    assert found.json()["floorplan_id"] == home, found.text
    session = client.post("/sessions", json={"floorplan_id": home}).json()["id"]
    for content in features:
        tracked = document_of(client.post(f"/sessions/{session}/photographs", files={"features": content}))
    assert tracked["photographs"] == 2


def test_features_have_no_photograph_to_draw(client: httpx.Client, home: str, device: Device) -> None:
    features, svg = {"features": device.features(KITCHEN)}, {"Accept": "image/svg+xml"}
    data = {"floorplan_id": home, "refine": "none"}
    drawn = client.post("/localise", data=data, files=features, headers=svg)
    assert drawn.status_code == 200, drawn.text
    assert "data:image/jpeg" not in drawn.text
    refused = client.post("/localise", data=data, files=features, headers=svg, params={"picture": "photograph"})
    assert assert_problem(refused, 422, "invalid-request")["errors"][0]["field"] == "picture"


def with_header(content: bytes, **changes: Any) -> bytes:
    magic, version, length = PREFIX.unpack_from(content)
    header = json.loads(content[PREFIX.size : PREFIX.size + length])
    text = json.dumps(header | changes).encode()
    return PREFIX.pack(magic, version, len(text)) + text + content[PREFIX.size + length :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:9],
        lambda content: content[:-4],
        lambda content: content + b"\0",
        lambda content: KITCHEN,
        lambda content: content[:-4] + struct.pack("<f", math.nan),
        lambda content: content[:-4] + struct.pack("<f", 1e30),
        lambda content: PREFIX.pack(b"LLFT", 2, 0) + content[PREFIX.size :],
        lambda content: PREFIX.pack(b"LLFT", 1, 2**31) + content[PREFIX.size :],
        lambda content: PREFIX.pack(b"LLFT", 1, 8000) + 8000 * b"[",
        lambda content: with_header(content, more=1),
        lambda content: with_header(content, patches=[0]),
        lambda content: with_header(content, projection="perspective"),
        lambda content: with_header(content, seen_deg=[90.0, -90.0]),
        lambda content: with_header(content, hfov={"value_deg": math.nan, "std_deg": 0.0, "source": "exif"}),
        lambda content: with_header(content, warnings=["\x1b[2J"]),
        lambda content: content + bytes(MAX_BYTES),
    ],
)
def test_damaged_features_are_refused(
    client: httpx.Client, home: str, device: Device, damage: Callable[[bytes], bytes]
) -> None:
    answer = ask(client, "features", damage(device.features(KITCHEN)), floorplan_id=home)
    assert_problem(answer, 422, "invalid-features")


def test_bytes_at_random_places_never_break_the_reader(device: Device) -> None:
    rng, content = random.Random(0), device.features(PHONE)
    for _ in range(200):
        changed = bytearray(content)
        for _ in range(rng.choice((1, 4, 64))):
            changed[rng.randrange(700 if rng.random() < 0.7 else len(content))] = rng.randrange(256)
        with suppress(ValueError):
            read_features(bytes(changed), device.bundle)


def test_features_of_another_model_are_refused(client: httpx.Client, home: str, device: Device) -> None:
    foreign = with_header(device.features(KITCHEN), model="0" * 64)
    problem = assert_problem(ask(client, "features", foreign, floorplan_id=home), 409, "foreign-features")
    assert device.bundle.sha256 in problem["detail"]


def test_camera_is_stated_when_features_are_computed(client: httpx.Client, home: str, device: Device) -> None:
    features = device.features(PHONE)
    stated = assert_problem(
        ask(client, "features", features, floorplan_id=home, pitch_deg=3, hfov_deg=60), 422, "invalid-request"
    )
    assert [fault["field"] for fault in stated["errors"]] == ["hfov_deg", "pitch_deg"]
    both = client.post("/localise", data={"floorplan_id": home}, files={"features": features, "photo": PHONE})
    assert assert_problem(both, 422, "invalid-request")["errors"][0]["field"] == "features"


def test_device_needs_the_served_files_only(client: httpx.Client, device: Device, tmp_path: Path) -> None:
    for name in DEVICE_FILES:
        served = client.get(f"/model/{name}")
        assert served.status_code == 200, served.text
        (tmp_path / name).write_bytes(served.content)
        again = client.get(f"/model/{name}", headers={"If-None-Match": served.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
    for name in ("head.onnx", "cohort.npz", "..%2Fmanifest.json"):
        assert client.get(f"/model/{name}").status_code == 404
    bundle = Bundle.open(tmp_path)
    assert bundle.sha256 == device.bundle.sha256
    assert (bundle.manifest.training, bundle.manifest.metrics, bundle.manifest.errors) == ({}, {}, None)
    assert FeatureEncoder(bundle, threads=1).features(device.view(PHONE)) == device.features(PHONE)


def test_service_can_refuse_photographs(start_app: StartApp, tmp_path: Path, device: Device) -> None:
    with start_app(tmp_path, bundle=default_bundle(), require_features=True, request_deadline_s=90.0) as client:
        home = upload(client, HOME)
        assert ask(client, "features", device.features(PHONE), floorplan_id=home).status_code == 200
        session = client.post("/sessions", json={"floorplan_id": home}).json()["id"]
        refused = [
            ask(client, "photo", PHONE, floorplan_id=home),
            ask(client, "panorama", KITCHEN + bytes(MAX_BYTES), floorplan_id=home),
            ask(client, "photo", KITCHEN, PHONE, path="/localise/sequence", floorplan_id=home, motion="turn"),
            ask(client, "film", PHONE, path="/localise/sequence", floorplan_id=home, motion="turn"),
            client.post(f"/sessions/{session}/photographs", files={"photo": PHONE}),
        ]
        for answer in refused:
            assert "on_device" in assert_problem(answer, 403, "features-required")["detail"]


@pytest.mark.slow
def test_nothing_of_a_photograph_remains(
    tiny_view_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = random.Random(7).randbytes(48)
    comment = b"\xff\xfe\xff\xff" + (mark * 1366)[: 2**16 - 3]
    # Larger than what is kept in memory.
    photograph = KITCHEN[:2] + 24 * comment + KITCHEN[2:]
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    settings = {"LOG_LEVEL": "debug", "KEEP_ANSWERS_S": "600", "DECODE_WORKERS": "1", "DECODE_STALL_S": "100"}
    traces = []
    with (
        collector() as (endpoint, spans),
        running_service(tiny_view_bundle, tmp_path / "data", OTLP_ENDPOINT=endpoint, **settings) as service,
    ):
        plan_id = upload(service.client, HOME)
        fields = {"floorplan_id": plan_id, "heading_deg": "20"}
        keyed = {"Idempotency-Key": "one"}
        for photo in (photograph, photograph[:-20_000], mark + photograph):
            service.client.post("/localise", data=fields, files={"photo": photo}, headers=keyed)
        turn = {"floorplan_id": plan_id, "motion": "turn"}
        document_of(service.client.post("/localise/sequence", data=turn, files=_two(photograph)))
        session = service.client.post("/sessions", json={"floorplan_id": plan_id}).json()["id"]
        document_of(service.client.post(f"/sessions/{session}/photographs", files={"photo": photograph}))
        others = [
            service.client.post("/localise/batch", data={"floorplan_id": plan_id}, files=_two(photograph)),
            service.client.post("/localise", data=fields, files={"photo": photograph}, headers={"Accept": "image/png"}),
        ]
        assert [answer.status_code for answer in others] == [200, 200]
        assert service.client.post("/localise", data={"nothing": "1"}, files={"photo": photograph}).status_code == 422
        wait_for(lambda: len(spans) > 10, 20.0)
        traces = [span.SerializeToString() for span in spans]
        # A photograph is in work when the process is killed.
        for decoder in children(service.process.pid):
            os.kill(decoder, signal.SIGSTOP)
        sender = threading.Thread(target=_send, args=(str(service.client.base_url), fields, photograph))
        sender.start()
        wait_for(lambda: "lalaloc_requests_in_flight 1.0" in service.client.get("/metrics").text)
        _check_absent(mark, tmp_path, traces)
        service.process.kill()
        service.process.wait(60.0)
        sender.join(60.0)
    _check_absent(mark, tmp_path, traces)
    (tmp_path / "planted").write_bytes(photograph)
    with pytest.raises(AssertionError, match="planted"):
        _check_absent(mark, tmp_path, traces)


def _two(photograph: bytes) -> list[tuple[str, tuple[str, bytes]]]:
    return 2 * [("photo", ("p", photograph))]


def _send(base_url: str, fields: dict[str, str], photograph: bytes) -> None:
    with suppress(httpx.TransportError):
        httpx.post(f"{base_url}/localise", data=fields, files={"photo": photograph}, timeout=60.0)


def _check_absent(mark: bytes, folder: Path, traces: list[bytes]) -> None:
    """Check that no file (database, log, temporary files) and no trace contains a part of a photograph."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert {"log", "lalaloc.sqlite3"} <= {path.name for path in files}
    # In base64 the mark begins at any of three places in a group.
    forms = [mark[:24], mark[:24].hex().encode(), repr(mark[:24]).encode()[2:-1]]
    forms += [base64.b64encode(mark[skip : skip + 24]) for skip in range(3)]
    for name, content in [*((str(path), path.read_bytes()) for path in files), *(("trace", trace) for trace in traces)]:
        assert not any(form in content for form in forms), name


def test_range_of_a_file_of_the_model_resumes_it(client: httpx.Client) -> None:
    url = "/model/view_encoder.onnx"
    whole = client.get(url)
    size, etag = len(whole.content), whole.headers["etag"]
    assert whole.headers["accept-ranges"] == "bytes"

    def ranged(text: str, **headers: str) -> httpx.Response:
        return client.get(url, headers={"Range": text, **headers})

    for text, first, last in (
        (f"bytes={size - 1000}-", size - 1000, size - 1),
        ("bytes=5-9", 5, 9),
        ("bytes=-7", size - 7, size - 1),
        (f"bytes=5-{10 * size}", 5, size - 1),
    ):
        part = ranged(text, **{"If-Range": etag})
        assert (part.status_code, part.content) == (206, whole.content[first : last + 1])
        assert part.headers["content-range"] == f"bytes {first}-{last}/{size}"
    for text in ("bytes=9-5", "bytes=-", "lines=1-2", "bytes=0-1,4-5"):
        assert ranged(text).status_code == 200
    assert ranged("bytes=5-9", **{"If-Range": '"other"'}).content == whole.content
    beyond = ranged(f"bytes={size}-")
    assert_problem(beyond, 416, "range-not-satisfiable")
    assert beyond.headers["content-range"] == f"bytes */{size}"
    assert ranged("bytes=-0").status_code == 416


def test_packed_networks_of_a_phone_are_small(client: httpx.Client) -> None:
    loaded_bytes = len(client.get("/web/onnxruntime.wasm.gz").content)
    for name in (VIEW_ONNX, OBJECTS_ONNX):
        url = f"/model/{name}.planes.gz"
        packed = client.get(url)
        planes = gzip.decompress(packed.content)
        content, even = bytearray(len(planes)), -(-len(planes) // 2)
        content[::2], content[1::2] = planes[:even], planes[even:]
        whole = client.get(f"/model/{name}")
        assert content == whole.content
        assert packed.headers["etag"] != whole.headers["etag"]
        assert client.get(url, headers={"If-None-Match": packed.headers["etag"]}).status_code == 304
        loaded_bytes += len(packed.content)
    assert loaded_bytes < 20e6
    for name in ("manifest.json", "head.onnx"):
        assert client.get(f"/model/{name}.planes.gz").status_code == 404


def test_file_of_the_model_that_changed_is_a_503(start_app: StartApp, tmp_path: Path) -> None:
    own_bundle = shutil.copytree(default_bundle(), tmp_path / "bundle")
    with start_app(tmp_path, bundle=own_bundle, request_deadline_s=90.0) as client:
        path = own_bundle / "view_encoder.onnx"
        os.truncate(path, path.stat().st_size // 2)
        problem = assert_problem(client.get("/model/view_encoder.onnx"), 503, "model-file-changed")
        assert "view_encoder.onnx" in problem["detail"]
        assert str(tmp_path) not in problem["detail"]
        path.unlink()
        assert_problem(client.get("/model/view_encoder.onnx"), 503, "model-file-changed")


def test_file_of_the_model_that_ends_too_soon_closes_the_connection(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = model_files._read
    monkeypatch.setattr(
        model_files, "_read", lambda opened, position, size: read(opened, position, size)[: 2**20 - position]
    )
    with pytest.raises(httpx.RemoteProtocolError):
        client.get("/model/view_encoder.onnx", timeout=20.0)


def test_features_of_a_turn_without_angles_are_warned_about(client: httpx.Client, home: str, device: Device) -> None:
    features = device.features(PHONE)
    answer = ask(client, "features", features, features, path="/localise/sequence", floorplan_id=home, motion="turn")
    assert "features have no pictures that could overlap" in answer.json()["warnings"][0]


def test_every_part_of_a_file_is_sent_beside_other_clients(
    start_app: StartApp, app_store: Store, tmp_path: Path
) -> None:
    with start_app(tmp_path, bundle=default_bundle(), api_keys=True, rate_per_minute=0) as client:
        client.headers.update(bearer(make_key(app_store)))
        # On one connection: parsing is charged to its address until a request has a tenant, which is another client.
        for _ in range(12):
            assert client.get("/model/view_encoder.onnx", timeout=20.0).status_code == 200
