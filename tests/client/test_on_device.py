"""Photographs that stay on the client's device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from lalaloc_client import ConflictError, InvalidError, OnDeviceError, UnauthorisedError
from lalaloc_core.bundle import MANIFEST_NAME, default_bundle
from lalaloc_core.localise.encode.features import DEVICE_FILES
from tests.client.conftest import FailingServer, MakeClient, Planned
from tests.core.filmed import encode, needs_ffmpeg, turn
from tests.core.taken import EXAMPLES, jpeg
from tests.service.conftest import upload

KITCHEN, PHONE = EXAMPLES / "kitchen.jpg", EXAMPLES / "phone.jpg"
APP_SETTINGS = {"bundle": default_bundle(), "require_features": True, "request_deadline_s": 90.0}


@pytest.fixture(scope="module")
def home(app: httpx.Client) -> str:
    return upload(app, json.loads((EXAMPLES / "flat.json").read_text()))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "lalaloc" / "models"


@pytest.fixture
def service(app: httpx.Client, make_client: MakeClient, cache: Path) -> Iterator[Any]:
    with make_client(str(app.base_url)) as client:
        yield client


@pytest.mark.slow
def test_photographs_stay_on_the_device(service: Any, home: str, cache: Path) -> None:
    with pytest.raises(UnauthorisedError, match="features-required"):
        service.localise(home, KITCHEN, refine="none")
    assert service.localise(home, KITCHEN, on_device=True, refine="none").room == "kitchen"
    (folder,) = cache.iterdir()
    assert {path.name for path in folder.iterdir()} == set(DEVICE_FILES) - {MANIFEST_NAME}
    phone = service.localise(home, PHONE, on_device=True, refine="none").view.wall_direction
    # The phone looks to 335°, the walls run along the axes of the plan.
    assert phone is not None
    assert (phone.value_deg + 335.0 + 45.0) % 90.0 - 45.0 == pytest.approx(0.0, abs=3.0)
    with pytest.raises(OnDeviceError, match="hfov_deg is 900"):
        service.localise(home, PHONE, on_device=True, hfov_deg=900.0)


@needs_ffmpeg
@pytest.mark.slow
def test_film_stays_on_the_device(service: Any, home: str, tmp_path: Path) -> None:
    path = tmp_path / "turn.mp4"
    content = encode(turn()[:46], path)
    with pytest.raises(UnauthorisedError, match="features-required"):
        service.localise_film(home, path, hfov_deg=53.0, refine="none")
    answer = service.localise_film(home, content, on_device=True, hfov_deg=53.0)
    assert answer.poses[0].room == "living room"
    assert answer.film is not None
    assert (answer.film.frames_read, answer.film.frames_kept) == (46, len(answer.poses))
    times_s = [pose.time_s for pose in answer.poses]
    assert times_s == sorted(times_s)
    assert 0.0 <= times_s[0] < times_s[-1] <= answer.film.duration_s
    # The camera turns by 60° in a second, which the service knows as stated.
    for pose in answer.poses:
        angle = pose.view.relative_heading
        assert angle.source == "given"
        missed_deg = angle.value_deg - 60.0 * (pose.time_s - times_s[0])
        assert (missed_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=2.0)
    with pytest.raises(OnDeviceError, match="is no MP4, MOV, WebM or Matroska film"):
        service.localise_film(home, b"no film", on_device=True)


def test_photographs_of_a_turn_are_linked_on_the_device(service: Any, home: str) -> None:
    frames = [jpeg(frame) for frame in turn()[:13:4]]
    sent = service.encode_turn(frames, hfov_deg=53.0)
    assert sent.relative_heading_deg == pytest.approx([0.0, 24.0, 48.0, 72.0], abs=1.0)
    assert 0.5 <= sent.relative_heading_std_deg < 5.0
    assert sent.film is None
    found = service.localise_sequence(home, frames, motion="turn", on_device=True, hfov_deg=53.0, refine="none")
    angles = [pose.view.relative_heading for pose in found.poses]
    assert [angle.value_deg for angle in angles] == pytest.approx(sent.relative_heading_deg, abs=0.01)
    angles = {name: getattr(sent, name) for name in ("relative_heading_deg", "relative_heading_std_deg")}
    again = service.localise_sequence(home, sent.features, motion="turn", refine="none", **angles)
    assert again.poses[0].position == found.poses[0].position
    # Of features, nothing overlaps.
    assert service.encode_turn(sent.features).relative_heading_deg is None


def test_damaged_cache_is_loaded_again(service: Any, home: str, cache: Path) -> None:
    service.localise(home, PHONE, on_device=True, refine="none")
    (folder,) = cache.iterdir()
    whole = (folder / "view_encoder.onnx").read_bytes()
    (folder / "view_encoder.onnx").write_bytes(whole[:1000])
    (folder / "image_encoder.onnx").unlink()
    # A model in memory is not read again, so forget it.
    (getattr(service, "_client", service))._device.forget()
    service.localise(home, PHONE, on_device=True, refine="none")
    assert (folder / "view_encoder.onnx").read_bytes() == whole
    assert {path.name for path in folder.iterdir()} == set(DEVICE_FILES) - {MANIFEST_NAME}


def test_features_are_sent_as_such(service: Any, home: str, tmp_path: Path) -> None:
    from lalaloc_core.cli import main

    file = tmp_path / "phone.features"
    assert main(["encode", str(PHONE), "-o", str(file)]) == 0
    on_device = service.localise(home, PHONE, on_device=True, refine="none")
    assert service.localise(home, file, refine="none").room == on_device.room
    with pytest.raises(InvalidError, match="invalid-features"):
        service.localise(home, file.read_bytes() + b"0", refine="none")
    with pytest.raises(ValueError, match="cannot be in one query"):
        service.localise_sequence(home, [file, PHONE], motion="turn")


def test_altered_model_is_refused(
    make_client: MakeClient, failing: FailingServer, app: httpx.Client, cache: Path
) -> None:
    manifest = app.get("/model/manifest.json").content
    failing.plan = [Planned(200, manifest), Planned(200, b"not a network")]
    with make_client(failing.url) as client:
        with pytest.raises(OnDeviceError, match=r"image_encoder\.onnx' with the SHA-256"):
            client.localise("0" * 32, PHONE, on_device=True)
        failing.plan = [Planned(200, {"format_version": 2})]
        with pytest.raises(OnDeviceError, match="cannot be read"):
            client.localise("0" * 32, PHONE, on_device=True)
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_service_with_another_model_gets_its_features(
    make_client: MakeClient, failing: FailingServer, app: httpx.Client, cache: Path
) -> None:
    files = {name: app.get(f"/model/{name}").content for name in DEVICE_FILES if name != MANIFEST_NAME}
    manifest = Planned(200, app.get("/model/manifest.json").content)
    foreign = {"type": "urn:lalaloc:problem:foreign-features", "status": 409, "detail": "another model"}
    answers = [Planned(409, foreign), manifest, Planned(409, foreign)]
    failing.plan = [manifest, *(Planned(200, content) for content in files.values()), *answers]
    with make_client(failing.url, max_queries=1) as client, pytest.raises(ConflictError, match="another model"):
        client.localise("0" * 32, PHONE, on_device=True)
    # The files are cached by digest, so the manifest alone was read again.
    assert [request.path for request in failing.requests].count("/model/manifest.json") == 2
    assert len(failing.requests) == 7
