"""What may be said of the file of a plan, and what is told of reading it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from service.schemas.fields import ResponseModel


class ImportForm(BaseModel):
    """Fields beside the file of a plan; an empty field counts as left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: Literal["m", "cm", "mm", "in", "ft"] | None = Field(None, description="Unit of the file's coordinates.")
    scale: str | None = Field(
        None, description="Scale of a drawing on paper, such as `1:100`: of a PDF, an SVG with a size, or a scan."
    )
    metres_per_pixel: float | None = Field(
        None, gt=0, description="Length of a pixel, of a unit of an SVG, or of a point (1/72 inch) of a PDF."
    )
    known_distance: str | None = Field(
        None, description="Two points of the drawing and how far apart they are: `x0,y0,x1,y1,metres`."
    )
    level: str | None = Field(None, description="Name or number of the storey to take, where the file has several.")
    layers: str | None = Field(
        None, description="Take only these layers, groups or classes; separated by commas, in any case."
    )
    page: int | None = Field(None, ge=1, description="Page of a PDF; 1 if left out.")
    y_axis: Literal["up", "down"] | None = Field(
        None, description="Which way y points in the file, where it is not as its format has it."
    )
    ceiling_height_m: float | None = Field(
        None, ge=1, le=20, description="Ceiling of rooms whose file gives none; 2.5 m if left out."
    )
    name: str | None = Field(None, max_length=200, description="What to call the plan.")


class LayerAnswer(ResponseModel):
    """What was made of one layer, group, class or type of entities."""

    layer: str
    entities: int
    used_as: str


class LevelAnswer(ResponseModel):
    """The storey of the file that the plan is of."""

    name: str
    number: float | None = Field(description="0 is the ground floor; null where the file has no numbers.")
    elevation_m: float | None = Field(description="Height of its floor in the file; null where that is not known.")


class ImportReport(ResponseModel):
    """How the file of a plan was read."""

    format: str = Field(description="As it was recognised by the content.")
    level: LevelAnswer | None = Field(description="The storey, where the file has any.")
    metres_per_unit: float = Field(description="Length of a unit of the file's coordinates.")
    scale_source: str = Field(description="Where that was read.")
    is_draft: bool = Field(
        description="The plan was guessed from a picture or from lines alone: look at it before it is used."
    )
    layers: list[LayerAnswer] = Field(description="What was used for what, by layer.")
    notes: list[str] = Field(description="What was done.")
    warnings: list[str] = Field(description="What is likely wrong; the plan's `warnings` have these as well.")
    unsure: list[str] = Field(description="What was guessed or assumed.")
