"""What the client that blocks asks about panoramas."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Unpack

from lalaloc_client import operations, requests
from lalaloc_client.answers import GeoPoseAnswer, Localisation, SequenceLocalisation
from lalaloc_client.requests import Picture, PictureFormat, QueryOptions, Refine, SequenceRefine
from lalaloc_client.sender import Sender

if TYPE_CHECKING:
    from PIL.Image import Image


class QueryMethods(Sender):
    """Methods of `Client` about panoramas.

    However many are called at once, only as many are sent as the service takes; the others wait for their turn.
    """

    def localise(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        near: Mapping[str, float] | None = None,
        radius_m: float | None = None,
        rooms: Sequence[str] | None = None,
        strict: bool | None = None,
        refine: Refine | None = None,
        top_k: int | None = None,
        posterior: bool = False,
    ) -> Localisation:
        """Where in a plan a panorama was taken.

        Args:
            panorama: full sphere, twice as wide as high: the bytes or the path of a JPEG, PNG or WebP file, or a
                picture of PIL, which is sent as JPEG.
            heading_deg: azimuth of the picture's centre column, clockwise from the plan's +y; None: unknown, found.
            heading_tolerance_deg: how far off that may be, up to 45; None: not at all.
            camera_height_m: over the floor; None: the plan's, and if it has none, any.
            camera_height_std_m: standard deviation of that, which is solved for; None: the plan's, or 0.1; 0: exact.
            near: where the camera stood, about: {"x_m": 3.5, "y_m": 2.0} in the plan, or with an anchor {"latitude":
                48.1372, "longitude": 11.5757}.
            radius_m: how far from there it may have stood; needed with `near`.
            rooms: ids or names of rooms in one of which it stood.
            strict: whether nothing else is looked at than what hints and heading say; None: they may be wrong.
            refine: `none`, `vdr` or `lpo`, how far to go; None: as far as possible.
            top_k: how many candidates; None: as many as the service likes.
            posterior: whether to tell how probable every place of the plan is.
        """
        return self._query(
            operations.localisation,
            requests.localise_request,
            floorplan_id,
            panorama,
            heading_deg=heading_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
            near=near,
            radius_m=radius_m,
            rooms=rooms,
            strict=strict,
            posterior=posterior,
        )

    def answer(self, answer_id: str) -> Localisation:
        """An answer again by its `answer_id`, while the service keeps it."""
        return self._run(operations.localisation(requests.answer_request(answer_id), self._patience))

    def forget_answer(self, answer_id: str) -> None:
        """Have the service forget an answer that it keeps."""
        self._run(operations.delete(requests.answer_request(answer_id, "DELETE"), self._patience))

    def picture(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        picture: Picture = "both",
        *,
        picture_format: PictureFormat = "png",
        **asked: Unpack[QueryOptions],
    ) -> bytes:
        """Where in a plan a panorama was taken, as a picture 1600 pixels wide.

        Args:
            picture: `plan`, with the posterior as a heat map, the answer and its rivals; `photograph`, with the found
                layout drawn in; or `both`.
            picture_format: `png` or `svg`.

        The others are those of `localise`.
        """
        return self._query(
            operations.content, requests.drawn_request, floorplan_id, panorama, picture, picture_format, **asked
        )

    def localise_in_venue(
        self,
        venue_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        level: float | None = None,
        **asked: Unpack[QueryOptions],
    ) -> Localisation:
        """In which plan of a venue a panorama was taken, and where.

        Args:
            level: on which level the camera stood, as of hints: it may be wrong unless `strict`.

        The others are those of `localise`; `near` is a latitude and longitude, or in a venue with an anchor a point of
        the frame that all plans are drawn in.
        """
        return self._query(
            operations.localisation,
            requests.localise_request,
            None,
            panorama,
            venue_id=venue_id,
            level=level,
            **asked,
        )

    def geopose(
        self,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        floorplan_id: str | None = None,
        venue_id: str | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        accuracy_m: float | None = None,
    ) -> GeoPoseAnswer:
        """Where on Earth a panorama was taken, by the OSCP GeoPose protocol.

        Args:
            panorama: as of `localise`.
            floorplan_id, venue_id: what it was taken in; None of both: in a plan near the place, which is then needed.
            latitude, longitude: about where, degrees.
            accuracy_m: how far off that may be; None: not known.
        """
        return self._query(
            operations.geopose,
            requests.geopose_request,
            panorama,
            floorplan_id=floorplan_id,
            venue_id=venue_id,
            latitude=latitude,
            longitude=longitude,
            accuracy_m=accuracy_m,
        )

    def localise_sequence(
        self,
        floorplan_id: str,
        panoramas: Sequence[bytes | str | os.PathLike[str] | Image],
        *,
        motions: Sequence[Mapping[str, float] | None] | None = None,
        headings_deg: Sequence[float | None] | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        refine: SequenceRefine | None = None,
        top_k: int | None = None,
    ) -> SequenceLocalisation:
        """Where in a plan several panoramas of one visit were taken, answered jointly.

        Args:
            panoramas: in the order in which they were taken, each as for `localise`.
            motions: between neighbours, what was measured of {"distance_m": 2.4, "distance_std_m": 0.1, "turn_deg": 35,
                "turn_std_deg": 2, "direction_deg": 10, "direction_std_deg": 2}: the turn of the heading, clockwise, and
                the way's direction against the first heading. None where nothing was measured.
            headings_deg: of each panorama, None where it is unknown.
            heading_tolerance_deg: how far off those may be; None: not at all.
            camera_height_m, camera_height_std_m, top_k: as for `localise`; all panoramas share one height.
            refine: `none` or `lpo`, how far to go; None: as far as possible.
        """
        return self._query(
            operations.sequence,
            requests.sequence_request,
            floorplan_id,
            panoramas,
            motions=motions,
            headings_deg=headings_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
        )
