"""Photographs as requests describe them, and as answers say that they were read."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from lalaloc_core.answer_numbers import Score, Share
from lalaloc_core.localise.answers import documents
from lalaloc_core.localise.localisability.reports import AdvisedStep
from lalaloc_core.photograph import Intrinsics, StatedCamera
from lalaloc_core.photograph.projection import Source
from lalaloc_core.photograph.stated_camera import AUTO, HFOV_RANGE_DEG, MAX_PITCH_DEG, MAX_ROLL_DEG, Projection
from service.schemas.fields import CoreAnswer, Finite, ResponseModel, parse_json, reject_underscores

_HFOV_RANGES = ", ".join(
    f"{low:g} to {high:g} ({name})" for name, (low, high) in HFOV_RANGE_DEG.items() if name != AUTO
)
_Number = Annotated[float, Finite]


class StatedIntrinsics(BaseModel):
    """Camera matrix and distortion as OpenCV's calibration prints them, for the upright picture at its full size."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={"example": {"fx": 2870.0, "fy": 2868.0, "cx": 2010.5, "cy": 1509.0}},
    )

    fx: _Number = Field(description="Focal length, pixels.")
    fy: _Number = Field(description="Focal length, pixels.")
    cx: _Number | None = Field(None, description="Optical centre, pixels from the first one's. Default: the middle.")
    cy: _Number | None = Field(None, description="Optical centre, pixels from the first one's. Default: the middle.")
    k1: _Number = Field(0.0, description="Radial distortion; of the fisheye model for `fisheye`, as k2 and k3.")
    k2: _Number = 0.0
    k3: _Number = 0.0
    k4: _Number = Field(0.0, description="Radial distortion of the fisheye model only.")
    p1: _Number = Field(0.0, description="Tangential distortion, not of the fisheye model.")
    p2: _Number = 0.0


class PhotographFields(BaseModel):
    """Form fields about the camera of a photograph."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    projection: Literal["auto", "equirectangular", "perspective", "cylindrical", "fisheye"] = Field(
        "auto",
        description="Projection of the photograph: `equirectangular` (360° cameras), `perspective` (ordinary cameras), "
        "`cylindrical` (strips of a phone's panorama mode) or `fisheye`. `auto` decides by photo sphere metadata, then "
        "by the picture itself, then by the EXIF focal length.",
    )
    hfov_deg: _Number | None = Field(
        None,
        description=f"Horizontal field of view of the upright photograph, degrees: {_HFOV_RANGES}. Default: from the "
        "metadata, else estimated from straight lines, with a warning.",
    )
    intrinsics: StatedIntrinsics | None = Field(
        None, description="Camera matrix and distortion as a JSON object, instead of `hfov_deg`."
    )
    pitch_deg: _Number | None = Field(
        None,
        description="Elevation of the photograph's centre above the horizon, degrees, at most "
        f"{MAX_PITCH_DEG:g} either way. Default: from the metadata, else estimated from straight lines.",
    )
    roll_deg: _Number | None = Field(
        None,
        description="Clockwise rotation of the camera about its optical axis, degrees, at most "
        f"{MAX_ROLL_DEG:g} either way. Default: as for `pitch_deg`.",
    )

    _parse_intrinsics = field_validator("intrinsics", mode="before")(
        parse_json('a JSON object such as {"fx": 2870, "fy": 2868}')
    )
    _check_angles = field_validator("hfov_deg", "pitch_deg", "roll_deg", mode="before")(reject_underscores)

    @property
    def stated_camera(self) -> StatedCamera:
        """The statements for the core, which checks them."""
        intrinsics = None if self.intrinsics is None else Intrinsics(**self.intrinsics.model_dump())
        return StatedCamera(
            projection=self.projection,
            hfov_deg=self.hfov_deg,
            intrinsics=intrinsics,
            pitch_deg=self.pitch_deg,
            roll_deg=self.roll_deg,
        )


class AssumedAngle(CoreAnswer, documents.Angle, frozen=True):
    """Angle that the photograph was read with."""


class CameraAnswer(CoreAnswer, documents.CameraMatrix, frozen=True):
    """Camera matrix and distortion of the upright photograph, as `intrinsics` of the request."""


class SeenArc(CoreAnswer, documents.SeenArc, frozen=True):
    """Azimuths that photographs show, relative to the centre of the first, clockwise."""


class ReadView(ResponseModel):
    """Assumptions about the photograph, and the azimuths it shows."""

    projection: Projection
    projection_source: Source
    hfov: AssumedAngle = Field(description="Horizontal field of view.")
    pitch: AssumedAngle = Field(description="Elevation of the photograph's centre above the horizon.")
    roll: AssumedAngle = Field(description="Clockwise rotation of the camera about its optical axis.")
    wall_direction: AssumedAngle | None = Field(
        default=None,
        description="Azimuth of walls relative to the photograph's centre, up to quarter turns, by its straight lines; "
        "null without lines and for full spheres.",
    )
    camera: CameraAnswer | None = Field(
        description="Camera model, with which the plan's walls can be drawn over the photograph; null for full spheres "
        "and strips."
    )
    seen: list[SeenArc] = Field(description="Azimuths that the photographs behind the answer show.")
    warnings: list[str] = Field(description="Metadata that were ignored, and estimates to check.")


class SeenObjectAnswer(CoreAnswer, documents.SeenObject, frozen=True):
    """Object that the photograph shows."""


class NextStepAnswer(CoreAnswer, AdvisedStep, frozen=True):
    """Step after an answer that is not sure, and what it is expected to tell."""


class ViewAnswer(ReadView):
    """Assumptions about the photograph, the azimuths it shows, and how much it could tell."""

    information_bits: Score = Field(
        description="Information about the place, in bits: the divergence of the posterior from the shares of the "
        "searched area, hints included. 0: all places stay equally likely."
    )
    ruled_out: Share = Field(description="Share of the searched area that this rules out: 1 - 2 ** -information_bits.")
    relative_heading: AssumedAngle | None = Field(
        default=None,
        description="Heading minus that of the first photograph of a turn, from the request (`given`) or from what the "
        "photographs show twice (`estimated`); null where it was searched, and for other queries.",
    )
    advice: str | None = Field(
        description="How to photograph the place for a sure answer, such as `turn around`; null where it is sure, or "
        "where more of the surroundings would not help."
    )
    next_step: NextStepAnswer | None = Field(
        default=None,
        description="The single step with the highest expected confidence, by the posterior and the model's measured "
        "errors. Null where the confidence is null, or 0.5 or more, where no step raises it by 0.02, where the "
        "photograph is probably of no place of the plan, and for all but the first photograph of a turn.",
    )
    room_types: dict[str, Share] | None = Field(
        description="Probability of each type of room, the most probable first, by recognised objects; types "
        "below 0.05 are left out. Null for full spheres, and for features or models without objects."
    )
    objects: list[SeenObjectAnswer] | None = Field(
        description="Recognised objects that tell the type of room, the most probable first; null as `room_types`."
    )
