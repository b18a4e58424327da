"""Both clients with albums of the production app."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from lalaloc_client import ConflictError, InvalidError, NotFoundError
from lalaloc_core.bundle import default_bundle
from tests.client.conftest import MakeClient
from tests.core.taken import EXAMPLES
from tests.service.conftest import StartApp

HOME = json.loads((EXAMPLES / "flat.json").read_text())
FILES = [EXAMPLES / "kitchen.jpg", EXAMPLES / "bedroom.jpg"]


@pytest.fixture(scope="module")
def app(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Return an app with the shipped model, as the tiny one gives no features."""
    with start_app(tmp_path_factory.mktemp("data"), bundle=default_bundle(), request_deadline_s=90.0) as started:
        yield started


@pytest.fixture
def service(app: httpx.Client, make_client: MakeClient) -> Iterator[Any]:
    """Return a client of that app."""
    with make_client(str(app.base_url)) as client:
        yield client


def test_folder_is_pinned_corrected_and_taken_away(service: Any) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(HOME).id).id
    album = service.create_album(plan_id, name="Visit")
    assert (album.state, album.photographs) == ("empty", 0)
    added = list(service.add_to_album(album.id, [*FILES, b"no picture"]))
    assert [line.status for line in added] == [201, 201, 422]
    with pytest.raises(InvalidError):
        added[2].result()
    assert [line.status for line in service.add_to_album(album.id, FILES)] == [200, 200]
    solved = service.wait_until_solved(album.id)
    assert (solved.state, solved.photographs) == ("solved", 2)
    found = list(service.album_photographs(album.id, page_size=1))
    assert [row.name for row in found] == ["kitchen.jpg", "bedroom.jpg"]
    assert all(row.pin is not None and row.pin.suggestions for row in found)
    row = service.album_photograph(album.id, found[0].id)
    changed = service.correct_photograph(album.id, row.id, {"elsewhere": True}, if_match=row.etag)
    assert changed.correction is not None
    with pytest.raises(ConflictError):
        service.correct_photograph(album.id, row.id, None, if_match=row.etag)
    service.wait_until_solved(album.id)
    assert service.album_photograph(album.id, row.id).pin.place is None
    assert service.album_file(album.id, "csv").decode().count("kitchen.jpg") == 1
    assert service.album_file(album.id, "svg").startswith(b"<svg")
    with pytest.raises(ValueError, match="must be one of"):
        service.album_file(album.id, "pdf")
    assert [listed.id for listed in service.albums("visit")] == [album.id]
    service.delete_album_photograph(album.id, row.id)
    assert service.album(album.id).photographs == 1
    service.delete_album(album.id)
    with pytest.raises(NotFoundError):
        service.album(album.id)
