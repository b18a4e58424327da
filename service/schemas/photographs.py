"""Photographs as requests describe them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from lalaloc_core.photograph import Intrinsics, StatedCamera
from lalaloc_core.photograph.stated_camera import AUTO, HFOV_RANGE_DEG, MAX_PITCH_DEG, MAX_ROLL_DEG
from service.schemas.fields import Finite, parse_json, reject_underscores

_HFOV_RANGES = ", ".join(
    f"{low:g} to {high:g} ({name})" for name, (low, high) in HFOV_RANGE_DEG.items() if name != AUTO
)
_Number = Annotated[float, Finite]


class StatedIntrinsics(
    BaseModel,
    frozen=True,
    extra="forbid",
    json_schema_extra={"example": {"fx": 2870.0, "fy": 2868.0, "cx": 2010.5, "cy": 1509.0}},
):
    """Camera matrix and distortion as OpenCV's calibration prints them, for the upright picture at its full size."""

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
