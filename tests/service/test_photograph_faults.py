"""Photographs that are damaged, or no photographs, over HTTP: used with a warning, or named as what they are."""

from __future__ import annotations

import json

import httpx
import pytest

from tests.core.fault_photographs import CONTRADICTED, FAULTS, Fault, fault_id
from tests.core.taken import EXAMPLES
from tests.service.conftest import assert_problem, document_of

KITCHEN = (EXAMPLES / "kitchen.jpg").read_bytes()
# All files are sent alone; routes for several differ in how they name a file, so a third of the files do for them.
SOME = [
    pytest.param(fault, id=fault_id(fault), marks=[] if index % 3 == 0 else [pytest.mark.slow])
    for index, fault in enumerate(FAULTS)
]
APP_SETTINGS = {"bundle": "tiny_view_bundle"}


def data_of(fault: Fault, plan_id: str) -> dict[str, str]:
    return {"floorplan_id": plan_id, **fault.fields}


@pytest.mark.parametrize("fault", FAULTS, ids=fault_id)
def test_file_is_localised_right_or_refused_by_name(shipped: httpx.Client, home: str, fault: Fault) -> None:
    response = shipped.post("/localise", data=data_of(fault, home), files={"photo": (fault.name, fault.content)})
    if fault.is_usable:
        answer = document_of(response)
        fault.check(answer)
        assert fault.said is None or any(fault.said in text for text in answer["view"]["warnings"])
    else:
        fault.check_refusal(assert_problem(response, 422, "invalid-photograph")["detail"])


def test_contradicted_statement_is_named_at_a_low_confidence(shipped: httpx.Client, home: str) -> None:
    response = shipped.post(
        "/localise", data=data_of(CONTRADICTED, home), files={"photo": ("photo", CONTRADICTED.content)}
    )
    CONTRADICTED.check_warnings(response.json())


@pytest.mark.parametrize("fault", SOME)
def test_fault_in_a_batch_leaves_other_photographs_their_answers(
    shipped: httpx.Client, home: str, fault: Fault
) -> None:
    response = shipped.post("/localise/batch", data=data_of(fault, home), files=two_files(fault))
    first, second = map(json.loads, response.text.splitlines())
    assert "answer" in second
    if fault.is_usable:
        fault.check(first["answer"])
    else:
        fault.check_refusal(first["problem"]["detail"])


@pytest.mark.parametrize("fault", SOME)
def test_fault_in_a_sequence_is_named_with_its_photograph(shipped: httpx.Client, home: str, fault: Fault) -> None:
    fields = {name: value for name, value in data_of(fault, home).items() if name in ("floorplan_id", "intrinsics")}
    response = shipped.post("/localise/sequence", data=fields | {"motion": "turn"}, files=two_files(fault))
    if not fault.is_usable:
        detail = assert_problem(response, 422, "invalid-photograph")["detail"]
        fault.check_refusal(detail)
        assert "photo[0]" in detail
        return
    answer = response.json()
    # A single view twice is no evidence beyond itself, and the other photograph shows the kitchen.
    if not fault.fields and fault.room == "kitchen":
        assert {pose["room"] for pose in answer["poses"]} == {fault.room}
    assert fault.said is None or any(text.startswith("photo[0]") and fault.said in text for text in answer["warnings"])
    named = [fault.said is None or fault.said in str(pose["warnings"]) for pose in answer["poses"]]
    assert named == [True, fault.said is None or "intrinsics" in fault.fields]


@pytest.mark.parametrize("fault", SOME)
def test_fault_in_a_session_is_named_with_its_pose(shipped: httpx.Client, home: str, fault: Fault) -> None:
    session = shipped.post("/sessions", json={"floorplan_id": home}).json()["id"]
    response = shipped.post(
        f"/sessions/{session}/photographs", data=dict(fault.fields), files={"photo": (fault.name, fault.content)}
    )
    if fault.is_usable:
        fault.check(response.json()["pose"])
    else:
        fault.check_refusal(assert_problem(response, 422, "invalid-photograph")["detail"])


def two_files(fault: Fault) -> list[tuple[str, tuple[str, bytes]]]:
    """Return a file and a sphere; the file twice if its fields are not those of a sphere."""
    other = KITCHEN if "intrinsics" not in fault.fields else fault.content
    return [("photo", (fault.name, fault.content)), ("photo", ("other.jpg", other))]


@pytest.mark.parametrize("size", [10, 40_000, 400_000])
def test_part_without_a_file_name_asks_for_one(client: httpx.Client, flat: str, size: int) -> None:
    text = "must be a file (a part with a file name)"
    response = client.post("/localise", files={"floorplan_id": (None, flat), "photo": (None, bytes(size))})
    assert {"field": "photo", "message": text} in assert_problem(response, 422, "invalid-request")["errors"]
    large = client.post("/localise", files={"floorplan_id": (None, bytes(40_000)), "photo": ("p", b"")})
    (fault,) = assert_problem(large, 422, "invalid-request")["errors"]
    assert fault == {"field": "floorplan_id", "message": "has more than 32768 bytes, the limit of a field"}


def test_photograph_as_the_body_asks_for_a_form(client: httpx.Client, flat: str) -> None:
    response = client.post(f"/localise?floorplan_id={flat}", content=KITCHEN, headers={"Content-Type": "image/jpeg"})
    (fault,) = assert_problem(response, 422, "invalid-request")["errors"]
    assert fault["field"] == "floorplan_id"
    assert "send fields in the body, which is multipart/form-data" in fault["message"]
    response = client.post("/localise", content=KITCHEN, headers={"Content-Type": "image/jpeg"})
    assert "send multipart/form-data" in assert_problem(response, 415, "unsupported-media")["detail"]
