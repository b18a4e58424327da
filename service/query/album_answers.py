"""Solution of an album as it is stored and answered: pins of photographs, and their common part."""

from __future__ import annotations

import math
from collections.abc import Mapping

from lalaloc_core.localise.album.pins import MOVED_M, Album, Pin, PinPose
from service.query.geopose import geopose_at
from service.query.ground import Ground
from service.query.queries import AlbumOutcome
from service.schemas import Position
from service.schemas.albums import (
    AlbumSolution,
    MovedFrom,
    PinAnswer,
    PinCounts,
    PinPlace,
    PinSuggestion,
    RoomProbability,
    SharedCameraAnswer,
)


def compose_outcome(
    album: Album,
    ground: Ground,
    before: Mapping[str, str | None],
    dropped: Mapping[str, str],
    default_height_m: float,
    *,
    is_same_place: bool,
) -> AlbumOutcome:
    """Return a solution as JSON.

    By photograph there are the pins `before` as JSON, of this revision of the plan or venue if `is_same_place`, and why
    corrections were left out (`dropped`). The default height is for poses on Earth, if the album tells none.
    """
    height_m = album.camera_height_m if album.camera_height_m is not None else default_height_m
    places = _Places(ground, height_m, is_same_place=is_same_place)
    pins = dict[str, PinAnswer]()
    for pin in album.pins:
        text = before.get(pin.photograph_id)
        earlier = None if text is None else PinAnswer.model_validate_json(text)
        pins[pin.photograph_id] = places.pin(pin, earlier, dropped.get(pin.photograph_id))
    solution = AlbumSolution(
        pins=PinCounts(**album.counts, moved=sum(pin.moved is not None for pin in pins.values())),
        cameras=[
            SharedCameraAnswer(
                make=camera.make,
                model=camera.model,
                width=camera.width,
                height=camera.height,
                photographs=camera.photographs,
                hfov_deg=math.degrees(camera.hfov),
                hfov_std_deg=math.degrees(camera.hfov_sd),
            )
            for camera in album.cameras
        ],
        camera_height_m=album.camera_height_m,
        scale=album.scale,
        compass_bias_deg=None if album.compass_bias is None else math.degrees(album.compass_bias),
        warnings=[*ground.warnings, *album.warnings],
    )
    return AlbumOutcome(
        solution=solution.model_dump_json(), pins={key: pin.model_dump_json() for key, pin in pins.items()}
    )


class _Places:
    """Places of a ground as answers name them."""

    def __init__(self, ground: Ground, camera_height_m: float, *, is_same_place: bool) -> None:
        ids = [record.id for record in ground.records]
        self._revisions = dict(zip(ids, [record.revision_id for record in ground.records], strict=True))
        self._levels = dict(zip(ids, ground.levels, strict=True))
        self._anchors = dict(zip(ids, ground.anchors, strict=True))
        self._height_m = camera_height_m
        self._is_same_place = is_same_place

    def pin(self, pin: Pin, earlier: PinAnswer | None, dropped: str | None) -> PinAnswer:
        """Return a pin, with what changed since `earlier`."""
        place = None if pin.pose is None else self._place(pin.pose)
        geopose = None
        if pin.pose is not None:
            position, heading_deg = (pin.pose.x_m, pin.pose.y_m), pin.pose.heading_deg or 0.0
            geopose = geopose_at(self._anchors[pin.pose.plan_id], position, heading_deg, self._height_m)
        return PinAnswer(
            state=pin.state,
            place=place,
            confidence=_share(pin.confidence),
            within_1m=_share(pin.within_1m),
            reason=pin.reason,
            rooms=[
                RoomProbability(
                    floorplan_id=room.plan_id,
                    room=room.room,
                    room_id=room.room_id,
                    probability=_share(room.probability),
                )
                for room in pin.rooms
            ],
            suggestions=[
                PinSuggestion(**vars(self._place(suggestion.pose)), probability=_share(suggestion.probability))
                for suggestion in pin.suggestions
            ],
            warnings=[*pin.warnings, *([] if dropped is None else [dropped])],
            geopose=geopose,
            moved=None if pin.state == "corrected" else self._moved(earlier, place),
        )

    def _place(self, pose: PinPose) -> PinPlace:
        return PinPlace(
            floorplan_id=pose.plan_id,
            floorplan_revision=self._revisions[pose.plan_id],
            level=self._levels[pose.plan_id],
            room=pose.room,
            room_id=pose.room_id,
            position=Position(x_m=pose.x_m, y_m=pose.y_m),
            heading_deg=pose.heading_deg,
        )

    def _moved(self, earlier: PinAnswer | None, after: PinPlace | None) -> MovedFrom | None:
        """Return the change of a pin by new revisions of its plan; that by an earlier solve of this one stays."""
        if earlier is None:
            return None
        before = earlier.place
        # Without a place, the revision is not known.
        if before is None:
            return earlier.moved
        revision = self._revisions.get(before.floorplan_id)
        # Of large venues, the plans that are searched depend on the photographs: others are left out unchanged.
        if revision == before.floorplan_revision or (revision is None and self._is_same_place):
            return earlier.moved
        return MovedFrom(before=before, distance_m=None, new_room=True) if after is None else _change(before, after)


def _change(before: PinPlace, after: PinPlace) -> MovedFrom | None:
    same_plan = before.floorplan_id == after.floorplan_id
    distance_m = None
    if same_plan:
        distance_m = math.dist((before.position.x_m, before.position.y_m), (after.position.x_m, after.position.y_m))
    new_room = not same_plan or before.room_id != after.room_id
    if not new_room and (distance_m is None or distance_m <= MOVED_M):
        return None
    return MovedFrom(before=before, distance_m=distance_m, new_room=new_room)


def _share(value: float) -> float:
    # Sums of shares can exceed 1 by rounding.
    return min(max(value, 0.0), 1.0)
