"""Sessions on the page: a camera that is followed live."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import httpx
import pytest
from playwright.sync_api import expect

from tests.service.conftest import upload
from tests.service.test_sessions import begin, send
from tests.web.conftest import EXAMPLES, Visit

FLAT = json.loads((EXAMPLES / "flat.json").read_text())


@pytest.fixture
def plan_id(service: httpx.Client) -> Iterator[str]:
    plan_id = upload(service, FLAT | {"name": "Followed flat"})
    yield plan_id
    service.delete(f"/floorplans/{plan_id}")


def test_photographs_one_after_the_other_are_followed(phone: Visit) -> None:
    page = phone.open_example()
    page.get_by_text("Follow a camera that moves").click()
    with page.expect_response("**/sessions") as begun:
        page.get_by_role("button", name="Follow a camera here").click()
    session_id = begun.value.json()["id"]
    expect(page.locator("#session-mode")).to_have_text("Add the first photograph.")
    assert page.evaluate("location.hash") == f"#session={session_id}"
    page.locator("#session-file").set_input_files([EXAMPLES / "kitchen.jpg", EXAMPLES / "living_room.jpg"])
    expect(page.locator("#session-pose")).to_contain_text("after 2 photographs")
    answer = phone.client.get(f"/sessions/{session_id}").json()
    expect(page.locator("#session-pose")).to_contain_text(answer["pose"]["room"])
    expect(page.locator("#session-mode")).to_have_class(f"mode {answer['mode']}")
    expect(page.locator("#plan .session .step")).to_have_count(2)
    expect(page.locator("#plan .session .covariance")).to_have_count(1)
    x_m, y_m = answer["pose"]["position"]["x_m"], answer["pose"]["position"]["y_m"]
    placed = page.locator("#session-camera").get_attribute("transform") or ""
    assert [float(value) for value in re.findall(r"-?[\d.]+", placed)[:2]] == pytest.approx([x_m, -y_m])
    with page.expect_response(lambda response: response.request.method == "DELETE"):
        page.get_by_role("button", name="Stop").click()
    expect(page.get_by_role("button", name="Follow a camera here")).to_be_visible()
    expect(page.locator("#plan .session > *")).to_have_count(0)
    assert phone.client.get(f"/sessions/{session_id}").status_code == 404


@pytest.mark.slow
def test_session_of_another_client_is_shown_live(desktop: Visit, plan_id: str) -> None:
    sphere = (EXAMPLES / "kitchen.jpg").read_bytes()
    session_id = begin(desktop.client, plan_id)
    send(desktop.client, session_id, sphere).raise_for_status()
    page = desktop.open(f"/#session={session_id}")
    expect(page.locator("#plan-name")).to_have_text("Followed flat")
    expect(page.locator("#session-pose")).to_contain_text("after 1 photograph")
    send(desktop.client, session_id, sphere, forward_m=0, turn_deg=0).raise_for_status()
    expect(page.locator("#session-pose")).to_contain_text("after 2 photographs")
    expect(page.locator("#plan .session .step")).to_have_count(2)
    # The session of another client goes on when this page stops to show it.
    page.get_by_role("button", name="Stop").click()
    assert desktop.client.get(f"/sessions/{session_id}").status_code == 200
    page.evaluate(f"location.hash = 'session={session_id}'")
    expect(page.locator("#session-pose")).to_contain_text("after 2 photographs")
    desktop.client.delete(f"/sessions/{session_id}")
    expect(page.get_by_text("The session has ended.")).to_be_visible()
