"""What a query says of the camera and of the answer, be it one picture or several."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.floorplan import MAX_CAMERA_HEIGHT_STD_M
from lalaloc_core.localise.camera_height import DEFAULT_STD_M, UNKNOWN_RANGE_M
from service.schemas.fields import Finite


class CameraFields(BaseModel):
    """Fields of a form about the camera's height, and how many answers are wanted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera_height_m: Annotated[float, Finite] | None = Field(
        None,
        ge=MIN_CAMERA_HEIGHT_M,
        description="Height of the camera over the floor; left out: the plan's, and where that has none either, any "
        f"between {UNKNOWN_RANGE_M[0]:g} and {UNKNOWN_RANGE_M[1]:g}.",
    )
    camera_height_std_m: Annotated[float, Finite] | None = Field(
        None,
        ge=0,
        le=MAX_CAMERA_HEIGHT_STD_M,
        description="Standard deviation of the error of the camera height, which is solved for; 0: it is exact. Left "
        f"out: the plan's, else {DEFAULT_STD_M:g}.",
    )
    top_k: int = Field(
        5,
        ge=1,
        description="How many distinct candidates to return, at most `max_top_k`.",
        json_schema_extra={"maximum": 100},
    )

    @field_validator("camera_height_m", "camera_height_std_m", "top_k", mode="before")
    @classmethod
    def _digits_alone(cls, value: object) -> object:
        if isinstance(value, str) and "_" in value:
            raise ValueError("not a number")
        return value

    @field_validator("top_k")
    @classmethod
    def _as_many_as_allowed(cls, value: int, told: ValidationInfo) -> int:
        most = (told.context or {}).get("max_top_k", math.inf)
        if value > most:
            raise ValueError(f"at most {most} are allowed (max_top_k)")
        return value
