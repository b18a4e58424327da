"""The TypeScript client in a browser, as `make web` builds it for the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, Route

from tests.service.conftest import FLAT, upload
from tests.web.conftest import EXAMPLES, Visit

ROOT = Path(__file__).parents[2]
_SETUP = """
const { Client, ServiceError } = await import("/web/client.js");
const photo = await (await fetch("/web/example-kitchen.jpg")).blob();
"""


def run(page: Page, script: str, argument: Any = None) -> Any:
    """Run statements that use the client and a photograph; return their result."""
    return page.evaluate(f"async (argument) => {{ {_SETUP} {script} }}", argument)


def test_batch_is_answered_line_by_line(desktop: Visit) -> None:
    page = desktop.open()
    lines = run(
        page,
        """
        const client = new Client();
        const { id } = await client.uploadPlan(await (await fetch("/web/example-flat.json")).blob());
        const lines = [], fields = { floorplan_id: id, refine: "none", heading_deg: 250 };
        for await (const line of client.localiseBatch(fields, [photo, new Blob(["x"]), photo])) {
          const error = line.problem && ServiceError.from(line.problem);
          lines.push([line.index, line.answer?.heading_deg ?? error.slug]);
        }
        return lines;
        """,
    )
    assert [lines[0], lines[2]] == [[0, 250], [2, 250]]
    assert lines[1] == [1, "invalid-photograph"]


@pytest.mark.slow
def test_broken_answer_says_what_to_do(desktop: Visit) -> None:
    script = """
        window.fetch = async () => new Response(new ReadableStream({ pull: (to) => to.error(new TypeError("")) }));
        return new Client().localiseBatch({}, [photo]).next().catch(({ title, detail }) => `${title}: ${detail}`);
        """
    assert run(desktop.open(), script).startswith("The connection broke off: Check that the service runs")


@pytest.mark.slow
def test_upload_reports_its_progress(desktop: Visit) -> None:
    plan_id, page = upload(desktop.client, json.loads((EXAMPLES / "flat.json").read_text())), desktop.open()
    progress, answer = run(
        page,
        """
        const progress = [], fields = { floorplan_id: argument, refine: "none" };
        const onProgress = (sent, total) => progress.push([sent, total]);
        return [progress, await new Client().localise(fields, photo, { onProgress })];
        """,
        plan_id,
    )
    sent, total = progress[-1]
    assert sent == total > (EXAMPLES / "kitchen.jpg").stat().st_size
    assert answer["floorplan_id"] == plan_id


@pytest.mark.slow
def test_overload_is_retried_a_bounded_number_of_times(desktop: Visit) -> None:
    page, waits = desktop.open(), ["1", "1", "1", "1"]
    problem = {"type": "urn:lalaloc:problem:overloaded", "title": "Overloaded", "status": 503, "detail": "full"}

    def refuse(route: Route) -> None:
        if waits:
            headers = {"Retry-After": waits.pop(), "Content-Type": "application/problem+json"}
            route.fulfill(status=503, headers=headers, body=json.dumps(problem))
        else:
            route.continue_()

    page.route("**/limits", refuse)
    refused = """
        const client = new Client({ attempts: argument, retryMs: 30000 });
        return await client.json("/limits").catch(({ status, slug, retryAfterS }) => [status, slug, retryAfterS]);
    """
    assert run(page, refused, 2) == [503, "overloaded", 1]
    assert len(waits) == 2
    assert run(page, refused, 3)["max_batch_photographs"] == 100


@pytest.mark.slow
def test_request_ends_at_its_timeout_and_when_it_is_aborted(desktop: Visit) -> None:
    page, held = desktop.open(), list[Route]()
    page.route("**/limits", lambda route: held.append(route))
    ended = run(
        page,
        """
        const client = new Client({ timeoutMs: 100 }), leaving = new AbortController();
        const late = await client.json("/limits").catch((error) => error instanceof ServiceError && error.title);
        const answer = client.json("/limits", { signal: leaving.signal, timeoutMs: 0 });
        leaving.abort();
        return [late, await answer.catch((error) => error.name)];
        """,
    )
    assert ended == ["The service took too long", "AbortError"]


def test_typed_problems_name_the_faulty_fields(desktop: Visit) -> None:
    plan_id, page = upload(desktop.client, FLAT), desktop.open()
    found = run(
        page,
        """
        return await new Client().localise({ floorplan_id: argument, radius_m: 2 }, photo)
          .catch(({ status, slug, faults, requestId }) => [status, slug, faults[0].field, requestId.length]);
        """,
        plan_id,
    )
    assert found == [422, "invalid-request", "radius_m", 32]


def test_package_has_the_version_of_the_api() -> None:
    package = json.loads((ROOT / "clients" / "typescript" / "package.json").read_text(encoding="utf-8"))
    api = (ROOT / "openapi.yaml").read_text(encoding="utf-8")
    assert f"version: {package['version']}\n" in api
