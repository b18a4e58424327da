"""Solution of an album as it is stored and answered: pins of photographs, and their common part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lalaloc_core.localise.album.pins import Album, Pin, PinPose, moved_pin
from lalaloc_core.localise.answers.pinned import common_document, pin_document
from service.query.geopose import geopose_at
from service.query.ground import Ground
from service.query.queries import AlbumOutcome
from service.schemas.albums import AlbumSolution, MovedFrom, PinAnswer, PinCounts, PinPlace


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
        **common_document(album),
        pins=PinCounts(**album.counts, moved=sum(pin.moved is not None for pin in pins.values())),
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
        self._height_m, self._is_same_place = camera_height_m, is_same_place

    def pin(self, pin: Pin, earlier: PinAnswer | None, dropped: str | None) -> PinAnswer:
        """Return a pin, with what changed since `earlier`."""
        fields, pose = pin_document(pin), pin.pose
        place, geopose = None, None
        if pose is not None:
            place = PinPlace(**self._named(fields["place"]))
            anchor = self._anchors[pose.plan_id]
            geopose = geopose_at(anchor, (pose.x_m, pose.y_m), pose.heading_deg or 0.0, self._height_m)
        fields |= {
            "place": place,
            "rooms": [{"floorplan_id": room.pop("plan"), **room} for room in fields["rooms"]],
            "suggestions": [self._named(suggestion) for suggestion in fields["suggestions"]],
            "warnings": [*pin.warnings, *([] if dropped is None else [dropped])],
            "geopose": geopose,
            "moved": self._moved(pin, earlier, place),
        }
        return PinAnswer(**fields)

    def _named(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of a place with its stored plan."""
        plan_id = fields.pop("plan")
        plan = {"floorplan_revision": self._revisions[plan_id], "level": self._levels[plan_id]}
        return {"floorplan_id": plan_id, **plan, **fields}

    def _moved(self, pin: Pin, earlier: PinAnswer | None, after: PinPlace | None) -> MovedFrom | None:
        """Return the change of a pin by new revisions of its plan; that by an earlier solve of this one stays."""
        if earlier is None or pin.state == "corrected":
            return None
        before = earlier.place
        # Without a place, the revision is not known.
        if before is None:
            return earlier.moved
        revision = self._revisions.get(before.floorplan_id)
        # Of large venues, the plans that are searched depend on the photographs: others are left out unchanged.
        if revision == before.floorplan_revision or (revision is None and self._is_same_place):
            return earlier.moved
        moved = moved_pin(pin.photograph_id, _pose(before), None if after is None else _pose(after))
        return moved and MovedFrom(before=before, distance_m=moved.distance_m, new_room=moved.new_room)


def _pose(place: PinPlace) -> PinPose:
    position = place.position
    return PinPose(
        plan_id=place.floorplan_id,
        room_id=place.room_id,
        room=place.room,
        x_m=position.x_m,
        y_m=position.y_m,
        heading=None,
    )
