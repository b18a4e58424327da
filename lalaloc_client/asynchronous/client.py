"""Client for asyncio."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Sequence
from contextlib import aclosing
from typing import Unpack

from lalaloc_client.answers import BatchAnswer, Localisation, Readiness, SequenceLocalisation
from lalaloc_client.asynchronous.backend import run_blocking
from lalaloc_client.asynchronous.plans import AsyncPlans
from lalaloc_client.asynchronous.tracker import AsyncTracker
from lalaloc_client.on_device import TurnFeatures, filmed
from lalaloc_client.options import FilmOptions, QueryOptions, SequenceOptions, ViewOptions, earlier_name
from lalaloc_client.parsing import parse
from lalaloc_client.requests import (
    NDJSON,
    PICTURE_MEDIA,
    Photograph,
    Picture,
    PictureFormat,
    Request,
    film_request,
    query_request,
    resource_path,
)
from lalaloc_client.tracking import SessionOptions


class AsyncClient(AsyncPlans):
    """Client of a LaLaLoc service; close it, or use it in an `async with` block. One event loop uses a client.

    Every method raises `ProblemError` if the service answers with a problem, `ConnectionFailedError` if it does not
    answer, and `MalformedAnswerError` if the answer has another form; see `lalaloc_client.errors`. Queries wait in the
    client while the service already computes as many as it allows.
    """

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def ready(self) -> Readiness:
        """Return whether the service can answer at full quality."""
        # 503 means "not ready", which is an answer.
        return parse(Readiness, await self.content(Request("GET", "/readyz", answers=frozenset({200, 503}))))

    @earlier_name("panorama", "photograph")
    async def localise(
        self,
        floorplan_id: str,
        photograph: Photograph,
        *,
        posterior: bool = False,
        on_device: bool = False,
        **options: Unpack[QueryOptions],
    ) -> Localisation:
        """Localise a photograph in a plan.

        Args:
            floorplan_id: id of the plan.
            photograph: bytes or path of a JPEG, PNG, WebP or HEIC file, or a PIL image, which is sent as JPEG without
                metadata. Models without an encoder of views need full 360° spheres. Or the bytes or path of its
                features, a file that `lalaloc encode` writes.
            posterior: include the probability of every place of the plan in the answer.
            on_device: compute the features of the photograph on this device and send these alone. Needs the extra
                `onnx`; the first photograph loads the image encoder of the service, about 19 MB.
            **options: see `QueryOptions`.
        """
        values = {"floorplan_id": floorplan_id, "include": "posterior" if posterior else None}
        content = await self.localise_query("/localise", [photograph], values, options, on_device=on_device)
        return parse(Localisation, content)

    @earlier_name("panorama", "photograph")
    async def localise_in_venue(
        self,
        venue_id: str,
        photograph: Photograph,
        *,
        level: float | None = None,
        on_device: bool = False,
        **options: Unpack[QueryOptions],
    ) -> Localisation:
        """Localise a photograph in the plans of a venue.

        All is as for `localise`; `level` is that of the camera, a hint unless `strict` is set. `near` is a latitude and
        longitude, or, if the venue has an anchor, a point in the common frame of its plans.
        """
        values = {"venue_id": venue_id, "level": level}
        content = await self.localise_query("/localise", [photograph], values, options, on_device=on_device)
        return parse(Localisation, content)

    @earlier_name("panoramas", "photographs")
    async def localise_batch(
        self, floorplan_id: str, photographs: Sequence[Photograph], **options: Unpack[QueryOptions]
    ) -> AsyncIterator[BatchAnswer]:
        """Localise many photographs, each by itself, in a plan; yield their answers in order, as they are computed.

        A photograph that cannot be localised does not stop the others; `BatchAnswer.result` raises its error.

        There are at most the service's `max_batch_photographs`; the options hold for all of them.

        Raises:
            ConnectionFailedError: the connection broke off before the last answer.
        """
        values = {"floorplan_id": floorplan_id}
        async with self._concurrency.hold():
            request = await run_blocking(
                query_request, "/localise/batch", photographs, values, options, accept=NDJSON, streamed=True
            )
            async with aclosing(self._lines(BatchAnswer, request)) as lines:
                async for line in lines:
                    yield line

    @earlier_name("panoramas", "photographs")
    async def localise_sequence(
        self,
        floorplan_id: str | None,
        photographs: Sequence[Photograph],
        *,
        venue_id: str | None = None,
        on_device: bool = False,
        **options: Unpack[SequenceOptions],
    ) -> SequenceLocalisation:
        """Localise several photographs of one turn together, with `motion="turn"`.

        The photographs are in the order in which they were taken. With `venue_id` instead of the plan, all plans of the
        venue are searched; poses have `floorplan_id` and `level`. With `on_device`, as for `localise`, the angles are
        computed on this device, too.
        """
        values = {"floorplan_id": floorplan_id, "venue_id": venue_id}
        if on_device and options.get("relative_heading_deg") is None:
            content, _ = await self.localise_turn(photographs, values, options)
        else:
            content = await self.localise_query("/localise/sequence", photographs, values, options, on_device=on_device)
        return parse(SequenceLocalisation, content)

    async def localise_film(
        self,
        floorplan_id: str | None,
        film: bytes | str | os.PathLike[str],
        *,
        venue_id: str | None = None,
        on_device: bool = False,
        **options: Unpack[FilmOptions],
    ) -> SequenceLocalisation:
        """Localise a film of one slow turn, once around on the spot.

        The film is the content or path of an MP4, MOV, WebM or Matroska file. The frames that the service keeps become
        poses with `time_s`; `film` of the answer tells how it was read. With `on_device`, as for `localise`, it is read
        on this device, and the features of its frames and their angles alone are sent.
        """
        values = {"floorplan_id": floorplan_id, "venue_id": venue_id, "motion": "turn"}
        if on_device:
            content, sent = await self.localise_turn(film, values, options)
            return filmed(parse(SequenceLocalisation, content), sent)
        request = await run_blocking(film_request, "/localise/sequence", film, values, options)
        return parse(SequenceLocalisation, await self.content(request))

    async def encode_turn(
        self, turn: bytes | str | os.PathLike[str] | Sequence[Photograph], **options: Unpack[ViewOptions]
    ) -> TurnFeatures:
        """Compute the features of a film of a turn, or of its photographs in order, on this device; send nothing.

        `localise_sequence` takes them with `motion="turn"` and the relative headings, now or later.

        Args:
            turn: content or path of a film as for `localise_film`, or a list of photographs as for `localise_sequence`.

        Raises:
            OnDeviceError: the extra `onnx` is missing, or the turn cannot be read.
        """
        return await self._device.turn(turn, options)

    def track(
        self, floorplan_id: str | None = None, *, venue_id: str | None = None, **options: Unpack[SessionOptions]
    ) -> AsyncTracker:
        """Return a tracker, which follows a camera from photograph to photograph."""
        return AsyncTracker(self, floorplan_id, venue_id, options)

    @earlier_name("panorama", "photograph")
    async def picture(
        self,
        floorplan_id: str,
        photograph: Photograph,
        picture: Picture = "both",
        *,
        picture_format: PictureFormat = "png",
        **options: Unpack[QueryOptions],
    ) -> bytes:
        """Localise a photograph in a plan and return the answer as a picture 1600 pixels wide.

        The picture is that of the `plan` with the posterior as a heat map, the answer and the other candidates, that of
        the `photograph` with the layout drawn over it, or `both`.
        """
        if picture_format not in PICTURE_MEDIA:
            raise ValueError(f"picture_format is {picture_format!r}; it must be one of {', '.join(PICTURE_MEDIA)}")
        values = {"floorplan_id": floorplan_id}
        media, params = PICTURE_MEDIA[picture_format], {"picture": picture}
        return await self.query(query_request, "/localise", [photograph], values, options, params=params, accept=media)

    async def get_answer(self, answer_id: str) -> Localisation:
        """Return a stored answer by its `answer_id`."""
        return parse(Localisation, await self.content(Request("GET", resource_path("answers", answer_id))))

    async def forget_answer(self, answer_id: str) -> None:
        """Delete a stored answer."""
        await self._send(Request("DELETE", resource_path("answers", answer_id)))
