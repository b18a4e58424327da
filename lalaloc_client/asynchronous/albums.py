"""Albums of the client for asyncio."""

from __future__ import annotations

import uuid
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import replace
from random import random
from typing import Any, Unpack

from lalaloc_client.albums import FORMAT_MEDIA, AddedPhotograph, Album, AlbumFormat, AlbumPhotograph
from lalaloc_client.asynchronous.backend import run_blocking, sleep
from lalaloc_client.asynchronous.transport import AsyncTransport
from lalaloc_client.errors import AlbumFailedError, NotReadyError
from lalaloc_client.options import ViewOptions, earlier_name
from lalaloc_client.requests import NDJSON, Photograph, Request, json_request, query_request, resource_path, text_values


class AsyncAlbums(AsyncTransport):
    """Methods about albums: photographs that are pinned together to a plan or venue."""

    async def create_album(
        self,
        floorplan_id: str | None = None,
        *,
        venue_id: str | None = None,
        name: str | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        idempotency_key: str | None = None,
        **options: Unpack[ViewOptions],
    ) -> Album:
        """Create an album, whose photographs are pinned together to a plan, or to the plans of a venue.

        The camera is that of all photographs: `camera_height_m` and its deviation as in `QueryOptions`, and `options`.
        """
        given = {
            "floorplan_id": floorplan_id,
            "venue_id": venue_id,
            "name": name,
            "camera_height_m": camera_height_m,
            "camera_height_std_m": camera_height_std_m,
            **options,
        }
        document = {key: value for key, value in given.items() if value is not None}
        key = idempotency_key or uuid.uuid4().hex
        return await self._stored(Album, json_request("POST", "/albums", document, idempotency_key=key))

    async def album(self, album_id: str) -> Album:
        """Return an album."""
        return await self._stored(Album, Request("GET", resource_path("albums", album_id)))

    def albums(self, name: str | None = None, *, page_size: int = 100) -> AsyncIterator[Album]:
        """Yield the albums, newest first, page by page; with `name`, those with this text in their name."""
        return self._listed(Album, "/albums", name=name, limit=page_size)

    async def delete_album(self, album_id: str, *, if_match: str | None = None) -> None:
        """Delete an album with its photographs."""
        headers = {} if if_match is None else {"If-Match": if_match}
        await self._send(Request("DELETE", resource_path("albums", album_id), headers=headers))

    @earlier_name("panoramas", "photographs")
    async def add_to_album(self, album_id: str, photographs: Sequence[Photograph]) -> AsyncIterator[AddedPhotograph]:
        """Add photographs to an album; yield an answer for each, in order, as they are stored.

        The same picture is stored once, so that sending photographs again is safe. A photograph that cannot be read
        does not stop the others; `AddedPhotograph.result` raises its error. Photographs that the service is too busy
        for are sent again, as the client's `RetryPolicy` allows, where `total_s` limits the waits; their answers come
        last.

        Args:
            album_id: id of the album.
            photographs: photographs, each as for `localise`, at most the service's `max_batch_photographs`.

        Raises:
            ConnectionFailedError: the connection broke off before the last answer.
        """
        path = f"{resource_path('albums', album_id)}/photographs"
        left, attempt, waited_s = list(range(len(photographs))), 0, 0.0
        async with self._concurrency.hold():
            while left:
                attempt += 1
                busy = list[AddedPhotograph]()
                part = [photographs[index] for index in left]
                request = await run_blocking(query_request, path, part, {}, accept=NDJSON, streamed=True)
                async with aclosing(self._lines(AddedPhotograph, request)) as lines:
                    async for line in lines:
                        line = replace(line, index=left[line.index])
                        if line.retry_after_s is None:
                            yield line
                        else:
                            busy.append(line)
                after_s = max((line.retry_after_s or 0.0 for line in busy), default=0.0)
                wait_s = self._retry.wait_s(attempt, waited_s, after_s, random())
                left = [line.index for line in busy]
                if not left:
                    return
                if wait_s is None:
                    for line in busy:
                        yield line
                    return
                waited_s += wait_s
                await sleep(wait_s)

    def album_photographs(self, album_id: str, *, page_size: int = 100) -> AsyncIterator[AlbumPhotograph]:
        """Yield the photographs of an album with their pins, in the order in which they were added."""
        path = f"{resource_path('albums', album_id)}/photographs"
        return self._listed(AlbumPhotograph, path, limit=page_size)

    async def album_photograph(self, album_id: str, photograph_id: str) -> AlbumPhotograph:
        """Return a photograph of an album."""
        return await self._stored(AlbumPhotograph, Request("GET", _photograph_path(album_id, photograph_id)))

    async def album_file(self, album_id: str, album_format: AlbumFormat, *, floorplan_id: str | None = None) -> bytes:
        """Return the pins of an album as a file.

        The format is `geojson`, for plans with an anchor; `csv`; or `svg`, a drawing of the plan, which in a venue
        needs the `floorplan_id` of the plan whose pins are wanted.
        """
        if album_format not in FORMAT_MEDIA:
            raise ValueError(f"album_format is {album_format!r}; it must be one of {', '.join(FORMAT_MEDIA)}")
        path = f"{resource_path('albums', album_id)}/photographs"
        params = text_values({"floorplan_id": floorplan_id})
        return await self.content(Request("GET", path, params, {"Accept": FORMAT_MEDIA[album_format]}))

    async def correct_photograph(
        self, album_id: str, photograph_id: str, correction: Mapping[str, Any] | None, *, if_match: str | None = None
    ) -> AlbumPhotograph:
        """State where a photograph was taken; the rest of the album is then solved again.

        The correction is {"room_id": ...}, {"position": {"x_m": 3.5, "y_m": 2.0}, "heading_deg": 90}, {"elsewhere":
        True} or {"confirmed": True}; None undoes it. In a venue with `floorplan_id` as well. `if_match` is the `etag`
        that the photograph must have.
        """
        path = _photograph_path(album_id, photograph_id)
        return await self._stored(
            AlbumPhotograph, json_request("PATCH", path, {"correction": correction}, if_match=if_match)
        )

    async def delete_album_photograph(self, album_id: str, photograph_id: str) -> None:
        """Delete a photograph of an album; the rest is solved again."""
        await self._send(Request("DELETE", _photograph_path(album_id, photograph_id)))

    async def wait_until_solved(self, album_id: str, timeout_s: float = 300.0) -> Album:
        """Wait until the pins of an album are those of its latest change; return the album.

        Raises:
            AlbumFailedError: the album could not be solved.
            NotReadyError: it was not solved in time.
        """
        path = resource_path("albums", album_id)
        album, spent_s = await self._polled(Album, path, lambda album: album.state != "solving", timeout_s)
        if album.state == "failed":
            raise AlbumFailedError(album_id, album.reason)
        if album.state == "solving":
            raise NotReadyError(album_id, spent_s, album.progress, "album")
        return album


def _photograph_path(album_id: str, photograph_id: str) -> str:
    photograph = resource_path("photographs", photograph_id)
    return f"{resource_path('albums', album_id)}{photograph}"
