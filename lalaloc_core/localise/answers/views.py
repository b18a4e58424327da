"""Photographs as answers say that they were read, and how much they tell; the base of all answers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

from lalaloc_core.answer_numbers import Degrees, Score, Share, SignedDegrees
from lalaloc_core.localise.localisability.reports import NextStepAnswer
from lalaloc_core.photograph import Assumed
from lalaloc_core.photograph.cameras import Around, Camera, Fisheye
from lalaloc_core.photograph.projection import Source
from lalaloc_core.photograph.stated_camera import Projection, intrinsics_of


class Document:
    """Base of answers, which are plain data but for fields that `repr` leaves out."""

    # The numbers of documents are plain until the service validates, and so rounds, them.
    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", revalidate_instances="always")

    def document(self) -> dict[str, Any]:
        """Return the answer as plain data, for JSON."""
        return _plain(self)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value) if entry.repr}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True, kw_only=True)
class AssumedAngle(Document):
    """Angle that the photograph was read with."""

    value_deg: SignedDegrees
    std_deg: Annotated[Degrees, Field(description="Standard deviation; 0 where it does not apply.")]
    source: Annotated[
        Source,
        Field(
            description="Origin: the request (`given`), metadata (`gpano`, `exif`), the picture (`estimated`), or a "
            "usual value (`assumed`)."
        ),
    ]

    @classmethod
    def of(cls, assumed: Assumed) -> AssumedAngle:
        """Return an angle of a photograph."""
        return cls(value_deg=math.degrees(assumed.value), std_deg=math.degrees(assumed.sd), source=assumed.source)


@dataclass(frozen=True, kw_only=True)
class CameraAnswer(Document):
    """Camera matrix and distortion of the upright photograph, as `intrinsics` of the request."""

    width: Annotated[int, Field(description="Size of the upright photograph, pixels.")]
    height: int
    fx: Score
    fy: Score
    cx: Score
    cy: Score
    distortion: Annotated[
        list[float],
        Field(
            description="k1, k2, p1, p2 and k3 of a perspective camera, k1 to k4 of a fisheye camera: OpenCV's order."
        ),
    ]

    @classmethod
    def of(cls, camera: Camera | None) -> CameraAnswer | None:
        """Return the camera of a photograph; None for full spheres and strips."""
        if camera is None or isinstance(camera, Around):
            return None
        names = ("k1", "k2", "k3", "k4") if isinstance(camera, Fisheye) else ("k1", "k2", "p1", "p2", "k3")
        values = vars(intrinsics_of(camera))
        matrix = {name: values[name] for name in ("fx", "fy", "cx", "cy")}
        return cls(width=camera.width, height=camera.height, **matrix, distortion=[values[name] for name in names])


@dataclass(frozen=True, kw_only=True)
class SeenArc(Document):
    """Azimuths that photographs show, relative to the centre of the first, clockwise."""

    from_deg: SignedDegrees
    to_deg: Annotated[
        SignedDegrees, Field(description="Greater than `from_deg`; above 180 for an arc that passes the back.")
    ]


@dataclass(frozen=True, kw_only=True)
class SeenObjectAnswer(Document):
    """Object that the photograph shows."""

    name: Annotated[str, Field(description="Object, such as `stove`.")]
    probability: Share
    azimuth_deg: Annotated[
        SignedDegrees, Field(description="Direction relative to the photograph's centre, clockwise.")
    ]


@dataclass(frozen=True, kw_only=True)
class ReadView(Document):
    """Assumptions about the photograph, and the azimuths it shows."""

    projection: Projection
    projection_source: Source
    hfov: Annotated[AssumedAngle, Field(description="Horizontal field of view.")]
    pitch: Annotated[AssumedAngle, Field(description="Elevation of the photograph's centre above the horizon.")]
    roll: Annotated[AssumedAngle, Field(description="Clockwise rotation of the camera about its optical axis.")]
    wall_direction: Annotated[
        AssumedAngle | None,
        Field(
            description="Azimuth of walls relative to the photograph's centre, up to quarter turns, by its straight "
            "lines; null without lines and for full spheres."
        ),
    ] = None
    camera: Annotated[
        CameraAnswer | None,
        Field(
            description="Camera model, with which the plan's walls can be drawn over the photograph; null for full "
            "spheres and strips."
        ),
    ]
    seen: Annotated[list[SeenArc], Field(description="Azimuths that the photographs behind the answer show.")]
    warnings: Annotated[list[str], Field(description="Metadata that were ignored, and estimates to check.")]


@dataclass(frozen=True, kw_only=True)
class ViewAnswer(ReadView):
    """Assumptions about the photograph, the azimuths it shows, and how much it could tell."""

    information_bits: Annotated[
        Score,
        Field(
            description="Information about the place, in bits: the divergence of the posterior from the shares of the "
            "searched area, hints included. 0: all places stay equally likely."
        ),
    ]
    ruled_out: Annotated[
        Share, Field(description="Share of the searched area that this rules out: 1 - 2 ** -information_bits.")
    ]
    relative_heading: Annotated[
        AssumedAngle | None,
        Field(
            description="Heading minus that of the first photograph of a turn, from the request (`given`) or from what "
            "the photographs show twice (`estimated`); null where it was searched, and for other queries."
        ),
    ] = None
    advice: Annotated[
        str | None,
        Field(
            description="How to photograph the place for a sure answer, such as `turn around`; null where it is sure, "
            "or where more of the surroundings would not help."
        ),
    ]
    next_step: Annotated[
        NextStepAnswer | None,
        Field(
            description="The single step with the highest expected confidence, by the posterior and the model's "
            "measured errors. Null where the confidence is null, or 0.5 or more, where no step raises it by 0.02, "
            "where the photograph is probably of no place of the plan, and for all but the first photograph of a turn."
        ),
    ] = None
    room_types: Annotated[
        dict[str, Share] | None,
        Field(
            description="Probability of each type of room, the most probable first, by recognised objects; types below "
            "0.05 are left out. Null for full spheres, and for features or models without objects."
        ),
    ]
    objects: Annotated[
        list[SeenObjectAnswer] | None,
        Field(
            description="Recognised objects that tell the type of room, the most probable first; null as `room_types`."
        ),
    ]
