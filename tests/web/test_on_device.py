"""Photographs that stay on the device: the page computes features in the browser and sends these."""

from __future__ import annotations

import math
import re
import socket
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import ExifTags
from playwright.sync_api import Browser, Route, expect

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.localise.encode.features import FeatureEncoder, read_features
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.photograph import StatedCamera, open_photograph
from lalaloc_core.photograph.cameras import Around, Camera, Perspective
from tests.core.taken import EXAMPLES, jpeg, sphere, take
from tests.service.conftest import StartApp
from tests.web.conftest import DESKTOP, Visit, visit

BOX = "Keep this photograph on my device"
KITCHEN = (EXAMPLES / "kitchen.jpg").read_bytes()
# Loading, and the first run on a busy machine.
SLOW_MS = 180_000
APP_SETTINGS = {"bundle": default_bundle(), "request_deadline_s": 90.0}


class Wire:
    """Connection between the browser and the service that records everything the browser sends."""

    def __init__(self, port: int) -> None:
        self.sent = bytearray()
        wire = self

        class Forward(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                with socket.create_connection(("127.0.0.1", port)) as service:
                    back = threading.Thread(target=_copy, args=(service, self.request), daemon=True)
                    back.start()
                    _copy(self.request, service, wire.sent)
                    back.join(10.0)

        self.server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Forward)
        self.server.daemon_threads = True

    def bodies(self) -> list[bytes]:
        """Return the features that were sent."""
        return re.findall(rb'name="features".*?\r\n\r\n(LLFT.*?)\r\n------WebKit', bytes(self.sent), re.DOTALL)


def _copy(source: socket.socket, target: socket.socket, record: bytearray | None = None) -> None:
    try:
        while content := source.recv(2**16):
            if record is not None:
                record += content
            target.sendall(content)
        target.shutdown(socket.SHUT_WR)
    except OSError:
        pass


@contextmanager
def recorded(client: httpx.Client) -> Iterator[tuple[Wire, httpx.Client]]:
    """Give a wire to a service, and a client whose address is the wire's."""
    wire = Wire(client.base_url.port or 80)
    threading.Thread(target=wire.server.serve_forever, daemon=True).start()
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{wire.server.server_address[1]}") as through:
            yield wire, through
    finally:
        wire.server.shutdown()
        wire.server.server_close()


def find(page: Visit) -> str:
    """Localise the chosen photograph; return the text of the answer."""
    page.page.get_by_role("button", name="Find the place").click()
    expect(page.page.locator("#answer")).to_be_visible(timeout=SLOW_MS)
    return page.page.locator("#answer-body").inner_text()


def add(visited: Visit, name: str, content: bytes) -> None:
    file: Any = {"name": name, "mimeType": "image/jpeg", "buffer": content}
    visited.page.locator("#photo-file").set_input_files(file)
    expect(visited.page.locator("#photo-strip [aria-pressed=true]")).to_contain_text(name)


def fill(visited: Visit, settings: dict[str, str]) -> None:
    """Fill fields about the camera, which are folded at first."""
    page = visited.page
    page.locator("#settings").evaluate("(fold) => { fold.open = true; }")
    page.locator("#more").evaluate("(fold) => { fold.open = true; }")
    for label, value in settings.items():
        field = page.get_by_label(label)
        if label == "Kind":
            field.select_option(value)
        else:
            field.fill(value)


def taken(camera: Camera, **tilt: float) -> bytes:
    focal_mm = {ExifTags.Base.FocalLengthIn35mmFilm: 26} if isinstance(camera, Perspective) else None
    return jpeg(take(sphere("living_room"), camera, **tilt), focal_mm)


PHONE = Perspective.of_hfov(1280, 960, math.radians(67.3))
TILT = {"Tilted up by, °": "-6", "Leaning right by, °": "3"}
PHOTOGRAPHS: dict[str, tuple[bytes, dict[str, str], dict[str, Any]]] = {
    "sphere": (KITCHEN, {}, {}),
    "tilted sphere": (KITCHEN, TILT, {"pitch_deg": -6.0, "roll_deg": 3.0}),
    "phone": (taken(PHONE, pitch_deg=-6.0, roll_deg=3.0), TILT, {"pitch_deg": -6.0, "roll_deg": 3.0}),
    "strip": (
        taken(Around(width=1800, height=500, hfov=math.radians(200.0))),
        {"Kind": "panorama mode of a phone", "Field of view, °": "200"} | dict.fromkeys(TILT, "0"),
        {"projection": "cylindrical", "hfov_deg": 200.0, "pitch_deg": 0.0, "roll_deg": 0.0},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", PHOTOGRAPHS)
def test_features_replace_the_photograph(browser: Browser, service: httpx.Client, kind: str) -> None:
    content, settings, stated = PHOTOGRAPHS[kind]
    with recorded(service) as (wire, through):
        for visited in visit(browser, through, viewport=DESKTOP):
            page = visited.open_example()
            page.get_by_label(BOX).check()
            add(visited, "mine.jpg", content)
            fill(visited, settings)
            with page.expect_response("**/localise", timeout=SLOW_MS) as received:
                find(visited)
            answer = received.value.json()
            page.locator("#copy-python").click()
            expect(page.locator("#copied")).to_contain_text("on_device=True")
            with page.expect_download() as saving:
                page.get_by_role("button", name="Save picture").click()
            assert saving.value.suggested_filename == "lalaloc-mine.png"
        sent = bytes(wire.sent)
        # The picture of the answer is drawn by the page.
    (features,) = wire.bodies()
    # No part of the picture was sent, in any request.
    assert not any(content[start : start + 16] in sent for start in range(700, len(content) - 16, 997))
    assert b'name="photo"' not in sent
    bundle = Bundle.open(default_bundle())
    manifest = bundle.manifest
    view = open_photograph(
        content, sphere_size=sphere_size(manifest), patch_size=patch_size(manifest), stated=StatedCamera(**stated)
    )
    expected = read_features(FeatureEncoder(bundle, threads=1).features(view), bundle)
    found = read_features(features, bundle)
    assert (found.projection, found.projection_source) == (expected.projection, expected.projection_source)
    for name in ("hfov", "pitch", "roll"):
        own, other = getattr(found, name), getattr(expected, name)
        assert (own.value, own.sd, own.source) == (pytest.approx(other.value), pytest.approx(other.sd), other.source)
    assert found.azimuths == pytest.approx(expected.azimuths, abs=0.01)
    assert found.features
    assert expected.features
    assert found.features.azimuths == expected.features.azimuths
    for name, values in expected.features.outputs.items():
        difference = np.abs(found.features.outputs[name] - values).mean()
        if name == "object_azimuth":
            # Objects that are not there are anywhere.
            shown = expected.features.outputs["object_probability"] > 0.1
            difference = np.abs(found.features.outputs[name] - values)[shown].sum()
        assert difference < 0.02 + 0.03 * np.std(values), name
    fields = {name: str(value) for name, value in stated.items()} | {"floorplan_id": answer["floorplan_id"]}
    uploaded = service.post("/localise", data=fields, files={"photo": content}).json()
    assert answer["room"] == uploaded["room"]
    assert math.dist(*(tuple(each["position"].values()) for each in (answer, uploaded))) < 0.05


def _with_digest(service: httpx.Client, name: str, times: int) -> Any:
    """Return a handler that gives a file of the model another digest, a number of times."""
    manifest = service.get("/model/manifest.json").json()
    manifest["files"][name]["sha256"] = "0" * 64
    left = [manifest] * times

    def handle(route: Route) -> None:
        if left:
            route.fulfill(json=left.pop())
        else:
            route.continue_()

    return handle


@pytest.mark.slow
def test_another_model_is_noticed(browser: Browser, service: httpx.Client) -> None:
    for visited in visit(browser, service, viewport=DESKTOP):
        page = visited.open_example()
        page.get_by_label(BOX).check()
        error = page.locator("#photo-error")
        # The encoder is damaged.
        page.route("**/model/manifest.json", _with_digest(service, "image_encoder.onnx", 1))
        page.get_by_role("button", name="Find the place").click()
        expect(error).to_contain_text("SHA-256", timeout=SLOW_MS)
        # The service has got another model: the page loads it, and says so if that does not help.
        page.route("**/model/manifest.json", _with_digest(service, "head.onnx", 2))
        page.get_by_role("button", name="Find the place").click()
        expect(error).to_contain_text("another model than this page has loaded", timeout=SLOW_MS)
        page.route("**/model/manifest.json", _with_digest(service, "head.onnx", 1))
        find(visited)
        expect(error).to_be_hidden()


@pytest.mark.slow
def test_page_says_which_photographs_it_cannot_encode(browser: Browser, service: httpx.Client) -> None:
    for visited in visit(browser, service, viewport=DESKTOP):
        page = visited.open_example()
        page.get_by_label(BOX).check()
        error, button = page.locator("#photo-error"), page.get_by_role("button", name="Find the place")
        plain = jpeg(take(sphere("living_room"), PHONE, pitch_deg=-6.0, roll_deg=3.0))
        add(visited, "plain.jpg", plain)
        for settings, sentence in (
            ({"Field of view, °": "5"}, "it must be between 10° and 150°"),
            ({"Field of view, °": "", "Kind": "fisheye photograph"}, "no features of fisheye photographs"),
            ({"Kind": "360° photograph"}, "twice as wide as high"),
        ):
            fill(visited, settings)
            button.click()
            expect(error).to_contain_text(sentence, timeout=SLOW_MS)
        add(visited, "damaged.jpg", KITCHEN[:200])
        button.click()
        expect(error).to_contain_text("cannot decode “damaged.jpg”", timeout=SLOW_MS)
        # Lens and tilt of an ordinary photograph are estimated as the service does.
        add(visited, "unknown.jpg", plain)
        with page.expect_response("**/localise", timeout=SLOW_MS) as received:
            find(visited)
        view = received.value.json()["view"]
        assert [view[name]["source"] for name in ("hfov", "pitch", "roll")] == 3 * ["estimated"]
        assert view["hfov"]["value_deg"] == pytest.approx(67.3, abs=15.0)
        assert view["pitch"]["value_deg"] == pytest.approx(-6.0, abs=3.0)
        assert view["roll"]["value_deg"] == pytest.approx(3.0, abs=2.0)
        expect(page.locator("#answer-body .warning").first).to_contain_text("was estimated from straight lines")
        # A photograph of a session stays as well.
        page.locator("#follow").evaluate("(fold) => { fold.open = true; }")
        page.locator("#session-start").click()
        # Files that are chosen before the session exists are not sent.
        expect(page.locator("#session-stop")).to_be_visible(timeout=SLOW_MS)
        with page.expect_request("**/photographs", timeout=SLOW_MS) as asked:
            file: Any = {"name": "kitchen.jpg", "mimeType": "image/jpeg", "buffer": KITCHEN}
            page.locator("#session-file").set_input_files(file)
        assert b'name="photo"' not in (asked.value.post_data_buffer or b"")
        expect(page.locator("#session-pose")).to_contain_text("kitchen", timeout=SLOW_MS)


@pytest.mark.slow
def test_runtime_is_loaded_only_if_it_is_needed(desktop: Visit) -> None:
    urls: list[str] = []
    desktop.page.on("request", lambda request: urls.append(request.url))
    desktop.open_example()
    find(desktop)
    assert not [url for url in urls if "onnxruntime" in url or "on_device" in url or "/model/" in url]
    desktop.page.get_by_label(BOX).check()
    # The choice outlives the page.
    desktop.open_example()
    expect(desktop.page.get_by_label(BOX)).to_be_checked()
    find(desktop)
    names = {url.rpartition("/")[2] for url in urls}
    assert {"on_device.js", "onnxruntime.js", "onnxruntime.wasm.gz", "image_encoder.onnx.planes.gz"} <= names
    assert {url for url in urls if not url.startswith((str(desktop.client.base_url), "blob:"))} == set()


def test_only_the_worker_may_compile(service: httpx.Client) -> None:
    policies = {name: service.get(name).headers["content-security-policy"] for name in ("/", "/web/on_device.js")}
    assert "wasm-unsafe-eval" not in policies["/"]
    assert "script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'" in policies["/web/on_device.js"]
    runtime = service.get("/web/onnxruntime.wasm.gz")
    assert "content-encoding" not in runtime.headers
    again = service.get("/web/onnxruntime.wasm.gz", headers={"If-None-Match": runtime.headers["etag"]})
    assert again.status_code == 304


@pytest.mark.slow
def test_box_is_locked_where_features_are_required(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, bundle=default_bundle(), require_features=True, request_deadline_s=90.0) as client:
        for visited in visit(browser, client, viewport=DESKTOP):
            page = visited.open_example()
            expect(page.get_by_label(BOX)).to_be_checked()
            expect(page.get_by_label(BOX)).to_be_disabled()
            expect(page.locator("#on-device-state")).to_contain_text("takes no photographs")
            assert "kitchen" in find(visited)
