"""The WebXR sample in Chromium, which has no augmented reality here."""

from __future__ import annotations

import numpy as np
from playwright.sync_api import Browser, expect

from lalaloc_client.alignment import align
from lalaloc_client.frames import camera_matrix
from tests.client.test_robots_and_ar import device_world, rows_of, tilted, tracked
from tests.web.conftest import EXAMPLES, wait_until


def test_webxr_sample_opens_and_aligns_like_the_client(browser: Browser) -> None:
    world = device_world("opengl")
    poses = [tracked(3.0, 2.0, heading) for heading in (10.0, 130.0, 250.0)]
    cameras = [world @ np.array(camera_matrix(pose, "opengl")) @ tilted(0.3) for pose in poses]
    expected = align(poses, [rows_of(camera) for camera in cameras], "opengl", camera_height_m=1.5).world_from_plan
    with browser.new_context() as context:
        page, errors = context.new_page(), []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto((EXAMPLES / "ar" / "webxr.html").as_uri())
        expect(page.locator("#state")).to_have_text("This browser has no augmented reality by WebXR.")
        wait_until(page, "() => Boolean(globalThis.align)")
        given = [
            {"position": {"x_m": pose.position.x_m, "y_m": pose.position.y_m}, "heading_deg": pose.heading_deg}
            for pose in poses
        ]
        by_columns = [camera.T.ravel().tolist() for camera in cameras]
        found = page.evaluate("([poses, cameras]) => align(poses, cameras, 1.5)", [given, by_columns])
    assert errors == []
    np.testing.assert_allclose(np.array(found).reshape(4, 4).T, expected, atol=1e-6)
