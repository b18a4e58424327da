"""Both clients with albums of the production app."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest

from lalaloc_client import ConflictError, InvalidError, NotFoundError, RetryPolicy
from lalaloc_core.bundle import default_bundle
from service.errors import DeadlineExceededError
from service.query.localiser import LocalLocaliser
from service.query.queries import AlbumPhotographQuery
from tests.client.conftest import MakeClient
from tests.core.taken import EXAMPLES
from tests.service.conftest import HOME

FILES = [EXAMPLES / "kitchen.jpg", EXAMPLES / "bedroom.jpg"]
# The tiny model gives no features.
APP_SETTINGS = {"bundle": default_bundle(), "request_deadline_s": 90.0}


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


def busy_for(calls: int) -> Callable[..., Any]:
    """Return a `LocalLocaliser.answer` that misses its deadline in so many photographs of albums after the first."""
    left, answer = [0, *([1] * calls)], LocalLocaliser.answer

    async def busy(self: LocalLocaliser, where: Any, query: Any) -> Any:
        if isinstance(query, AlbumPhotographQuery) and left and left.pop(0):
            raise DeadlineExceededError(1.0)
        return await answer(self, where, query)

    return busy


def test_photographs_that_a_busy_service_refuses_are_sent_again(service: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(HOME).id).id
    album = service.create_album(plan_id)
    monkeypatch.setattr(LocalLocaliser, "answer", busy_for(3))
    added = list(service.add_to_album(album.id, [*FILES, b"no picture", EXAMPLES / "study.jpg"]))
    assert sorted((line.index, line.status) for line in added) == [(0, 201), (1, 201), (2, 422), (3, 201)]
    names = {line.index: line.name for line in added}
    assert (names[0], names[1], names[3]) == ("kitchen.jpg", "bedroom.jpg", "study.jpg")
    service.delete_album(album.id)


def test_photographs_are_sent_again_as_often_as_the_policy_allows(
    app: httpx.Client, make_client: MakeClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = busy_for(100)
    with make_client(str(app.base_url), retry=RetryPolicy(attempts=2)) as service:
        plan_id = service.wait_until_ready(service.upload_floorplan(HOME).id).id
        album = service.create_album(plan_id)
        monkeypatch.setattr(LocalLocaliser, "answer", calls)
        added = list(service.add_to_album(album.id, FILES))
        assert sorted(line.status for line in added) == [201, 504]
        assert added[-1].retry_after_s == 1
        service.delete_album(album.id)
