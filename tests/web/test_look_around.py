"""Guided turn on the page, with a fake camera that films a rendered home."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, CDPSession, Page, expect

from lalaloc_core.photograph.cameras import Perspective
from tests.core.filmed import encode, needs_ffmpeg, turn
from tests.core.taken import jpeg, sphere, take
from tests.service.conftest import upload
from tests.web.conftest import _ARGUMENTS, _BROWSERS, EXAMPLES, PHONE, Visit, visit, wait_until
from tests.web.test_on_device import BOX, SLOW_MS, recorded

FLAT = json.loads((EXAMPLES / "flat.json").read_text())
STEP_DEG = 3.0
PERMISSIONS = ["camera", "accelerometer", "gyroscope", "magnetometer"]
CAMERA = Perspective.of_hfov(360, 640, math.radians(53.0))
APP_SETTINGS = {"bundle": "tiny_view_bundle"}


@pytest.fixture(scope="module")
def camera(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Return a browser whose camera turns around in the example's living room."""
    room = sphere("living_room")
    film = tmp_path_factory.mktemp("film") / "turn.mjpeg"
    frames = [jpeg(take(room, CAMERA, heading_deg=STEP_DEG * index)) for index in range(round(360.0 / STEP_DEG))]
    # Each frame four times: the browser plays 30 frames per second, 22° of a turn.
    film.write_bytes(b"".join(frame for frame in frames for _ in range(4)))
    path = next(filter(None, map(shutil.which, _BROWSERS)))
    fakes = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    arguments = [*_ARGUMENTS, *fakes, f"--use-file-for-fake-video-capture={film}"]
    launched = browser.browser_type.launch(executable_path=path, args=arguments)
    yield launched
    launched.close()


@pytest.fixture
def phone(camera: Browser, service: httpx.Client) -> Iterator[Visit]:
    options = {"has_touch": True, "is_mobile": True, "permissions": PERMISSIONS, "reduced_motion": "reduce"}
    yield from visit(camera, service, viewport=PHONE, **options)


def _open(visited: Visit) -> Page:
    page = visited.open_example()
    page.get_by_role("button", name="Look around").click()
    return page


def _hold(protocol: CDPSession, alpha: float, beta: float = 90.0) -> None:
    """Turn the phone; alpha grows to the left."""
    angles = {"alpha": alpha, "beta": beta, "gamma": 0.0}
    protocol.send("DeviceOrientation.setDeviceOrientationOverride", angles)


def _no_violations(page: Page) -> None:
    results = Axe().run(page)
    assert results.violations_count == 0, results.generate_report()


@pytest.mark.slow
def test_turn_is_taken_by_itself_and_answered(phone: Visit) -> None:
    page = _open(phone)
    with page.expect_response("**/localise/sequence", timeout=120_000) as answered:
        expect(page.locator("#look-dialog video")).to_be_visible()
    poses = answered.value.json()["poses"]
    assert 10 <= len(poses) <= 30
    # Without a gyroscope, the photographs tell their angles.
    assert {(pose["view"]["relative_heading"] or {}).get("source") for pose in poses} <= {"estimated", None}
    _no_violations(page)
    expect(page.get_by_role("button", name="Show on the plan")).to_be_visible(timeout=60_000)
    # The room's lines move over the live picture.
    wait_until(
        page,
        """() => { const canvas = document.querySelector('#look-dialog canvas.lines');
        const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        return data.filter((value, index) => index % 4 === 3 && value > 0).length > 300; }""",
    )
    page.get_by_role("button", name="Show on the plan").press("Enter")
    expect(page.locator("#look-dialog")).to_be_hidden()
    expect(page.locator("#answer")).to_be_visible()
    wait_until(page, "document.querySelector('#look-dialog video').srcObject === null")


def test_gyroscope_gives_directions_and_hints(phone: Visit) -> None:
    page = _open(phone)
    protocol = page.context.new_cdp_session(page)
    _hold(protocol, 0.0)
    find = page.locator("#look-dialog .primary")
    expect(find).to_have_text(re.compile("\\(1 photo"))
    _hold(protocol, 0.0, beta=50.0)
    expect(page.locator("#look-hint")).to_have_text("Hold the phone upright, and level.")
    # Alpha grows to the left. A phone at rest takes no second photograph.
    for number, alpha in enumerate((335.0, 310.0), start=2):
        _hold(protocol, alpha)
        expect(find).to_have_text(re.compile(f"\\({number} photo"))
    find.click()
    expect(page.get_by_role("button", name="Show on the plan")).to_be_visible(timeout=60_000)
    expect(page.locator("#photo-strip li")).to_have_count(3)


@pytest.mark.slow
def test_refused_sensors_are_asked_for_again_and_used(phone: Visit) -> None:
    # As on iOS: the sensors are silent until they are allowed, and the first event has no angles.
    phone.page.add_init_script(
        """const answers = ['denied', 'granted'];
        const silence = (event) => { if (answers.length > 0) event.stopImmediatePropagation(); };
        addEventListener('deviceorientation', silence);
        DeviceMotionEvent.requestPermission = async () => 'granted';
        DeviceOrientationEvent.requestPermission = async () => {
          const answer = answers.shift();
          if (answer === 'granted') setTimeout(() => dispatchEvent(new DeviceOrientationEvent('deviceorientation')), 0);
          return answer;
        };"""
    )
    page = _open(phone)
    protocol, find = page.context.new_cdp_session(page), page.locator("#look-dialog .primary")
    _hold(protocol, 0.0)
    expect(find).to_have_text(re.compile("\\(1 photo"))
    page.get_by_role("button", name="Allow motion sensors").click()
    _hold(protocol, 1.0)
    expect(page.get_by_role("button", name="Allow motion sensors")).to_be_hidden()
    # The turn begins anew.
    expect(find).to_have_text(re.compile("\\(1 photo"))
    _hold(protocol, 335.0)
    expect(find).to_have_text(re.compile("\\(2 photo"))
    page.get_by_label(BOX).evaluate("box => box.click()")
    with page.expect_response("**/localise/sequence", timeout=SLOW_MS) as answered:
        find.click()
    angles = [pose["view"]["relative_heading"] for pose in answered.value.json()["poses"]]
    assert [angle["source"] for angle in angles] == ["given", "given"]


def test_only_features_leave_a_phone_with_the_box_ticked(camera: Browser, service: httpx.Client) -> None:
    with recorded(service) as (wire, through):
        for phone in visit(camera, through, viewport=PHONE, has_touch=True, is_mobile=True, permissions=PERMISSIONS):
            page = phone.open_example()
            page.get_by_label(BOX).check()
            protocol = page.context.new_cdp_session(page)
            page.get_by_role("button", name="Look around").click()
            find = page.locator("#look-dialog .primary")
            for number, alpha in enumerate((0.0, 335.0), start=1):
                _hold(protocol, alpha)
                expect(find).to_have_text(re.compile(f"\\({number} photo"))
            before = len(wire.sent)
            with page.expect_response("**/localise/sequence", timeout=SLOW_MS) as answered:
                find.click()
            angles = [pose["view"]["relative_heading"] for pose in answered.value.json()["poses"]]
    assert [angle["source"] for angle in angles] == ["given", "given"]
    assert angles[1]["value_deg"] == pytest.approx(25.0, abs=1.0)
    sent = bytes(wire.sent[before:])
    assert len(re.findall(rb'name="features".*?\r\n\r\nLLFT', sent, re.DOTALL)) == 2
    assert b'name="photo"' not in sent
    # No JPEG file leaves it.
    assert b"\xff\xd8\xff" not in sent


@pytest.mark.slow
def test_hints_for_walking_and_for_the_dark(phone: Visit) -> None:
    page = _open(phone)
    protocol, hint = page.context.new_cdp_session(page), page.locator("#look-hint")
    _hold(protocol, 0.0)
    expect(page.locator("#look-dialog .primary")).to_have_text(re.compile("\\(1 photo"))
    walk = "dispatchEvent(new DeviceMotionEvent('devicemotion', { acceleration: { x: 2, y: 0, z: 3 } }))"
    page.evaluate(f"for (let event = 0; event < 60; event++) {walk}")
    expect(hint).to_have_text("Stay on the spot: turn without walking.")
    stand = walk.replace("x: 2, y: 0, z: 3", "x: 0.1, y: 0, z: 0.1")
    page.evaluate(f"for (let event = 0; event < 120; event++) {stand}")
    expect(hint).to_have_text("Turn slowly to the right.")
    page.evaluate(
        """() => {
        const canvas = Object.assign(document.createElement('canvas'), { width: 360, height: 640 });
        const context = canvas.getContext('2d');
        context.fillStyle = '#0a0a0a';
        setInterval(() => context.fillRect(0, 0, 360, 640), 50);
        document.querySelector('#look-dialog video').srcObject = canvas.captureStream(20); }"""
    )
    _hold(protocol, 320.0)
    expect(hint).to_have_text("Too dark: switch on a light.")
    # Nothing is taken in the dark.
    expect(page.locator("#look-dialog .primary")).to_have_text(re.compile("\\(1 photo"))


@pytest.mark.slow
def test_camera_stops_with_the_dialog_by_keyboard_alone(phone: Visit) -> None:
    page = phone.open_example()
    page.locator("#look-around").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#look-dialog .primary")).to_be_enabled()
    track = page.evaluate_handle("document.querySelector('#look-dialog video').srcObject.getVideoTracks()[0]")
    take = page.get_by_role("button", name="Take a photograph")
    before = page.locator("#look-dialog .primary").text_content() or ""
    take.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#look-dialog .primary")).not_to_have_text(before)
    page.keyboard.press("Escape")
    expect(page.locator("#look-dialog")).to_be_hidden()
    wait_until(page, "track => track.readyState === 'ended'", track)
    expect(page.locator("#look-around")).to_be_focused()


@pytest.mark.slow
@needs_ffmpeg
def test_page_without_https_takes_a_film_and_says_why(phone: Visit, tmp_path: Path) -> None:
    page = phone.page
    page.add_init_script("Object.defineProperty(navigator, 'mediaDevices', { value: undefined })")
    _open(phone)
    expect(page.locator("#look-hint")).to_contain_text("Browsers allow the camera on HTTPS pages only")
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    page.locator("#look-film").set_input_files(tmp_path / "broken.mp4")
    expect(page.locator("#look-error")).to_contain_text("film")
    encode(turn(), tmp_path / "turn.mp4")
    page.locator("#look-film").set_input_files(tmp_path / "turn.mp4")
    expect(page.locator("#look-dialog")).to_be_hidden(timeout=60_000)
    expect(page.locator("#answer-body")).to_contain_text("photographs together")


@pytest.mark.slow
def test_link_for_the_phone_has_the_key_of_the_pages_link_only(desktop: Visit) -> None:
    plan_id, own = upload(desktop.client, FLAT | {"name": "Flat on a phone"}), str(desktop.client.base_url).rstrip("/")
    page, lan = desktop.open(f"/#plan={plan_id}"), "https://10.0.0.7"
    expect(page.locator("#plan-name")).to_have_text("Flat on a phone")
    page.get_by_role("button", name="On a phone").click()
    expect(page.locator("#phone-dialog")).to_contain_text("make serve-lan")
    expect(page.get_by_role("img", name="QR code")).to_have_count(0)
    page.route(f"{lan}/**", lambda route: route.fulfill(response=route.fetch(url=route.request.url.replace(lan, own))))
    page.goto(f"{lan}/#plan={plan_id}&key=lalaloc_run")
    expect(page.locator("#plan-name")).to_have_text("Flat on a phone")
    assert "lalaloc_run" not in page.url
    page.evaluate("sessionStorage.setItem('lalaloc-key', 'lalaloc_secret')")
    page.get_by_role("button", name="On a phone").click()
    assert page.locator("#phone-dialog a").get_attribute("href") == f"{lan}/#plan={plan_id}&key=lalaloc_run"
    expect(page.get_by_role("img", name="QR code")).to_be_visible()
    expect(page.locator("#phone-dialog")).to_contain_text("warn once of the certificate")
    assert "secret" not in page.locator("#phone-dialog").inner_html()
    assert desktop.client.get("/").headers["Permissions-Policy"].startswith("camera=(self), microphone=()")
    _no_violations(page)
    page.goto(f"{lan}/pin")
    expect(page.locator("#edit-plan")).to_have_attribute("href", f"/#plan={plan_id}&key=lalaloc_run")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angles", "attitude"),
    [
        ((0.0, 90.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((330.0, 90.0, 0.0, 0.0), (30.0, 0.0, 0.0)),
        ((0.0, 110.0, 0.0, 0.0), (0.0, 20.0, 0.0)),
        # The phone lies on its left side, and the screen is turned.
        ((90.0, 0.0, -90.0, 90.0), (0.0, 0.0, 0.0)),
    ],
)
def test_attitude_of_the_rear_camera(
    desktop: Visit, angles: tuple[float, ...], attitude: tuple[float, float, float]
) -> None:
    page = desktop.open()
    found = page.evaluate(f"import('/web/app.js').then(({{ cameraAttitude }}) => cameraAttitude(...{list(angles)}))")
    assert [found["yaw"], found["pitch"], found["roll"]] == pytest.approx(attitude, abs=1e-6)
