"""Options for reading a plan file, and the report on it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from service.schemas.fields import Problem, ResponseModel
from service.schemas.native_plan import OpeningKind


class _FileOptions(BaseModel):
    """Options of every import."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: Literal["m", "cm", "mm", "in", "ft"] | None = Field(None, description="Unit of the file's coordinates.")
    scale: str | None = Field(
        None, description="Scale of a drawing on paper, such as `1:100`, for a PDF, an SVG with a size, or a scan."
    )
    metres_per_pixel: float | None = Field(
        None, gt=0, description="Length of a pixel, of an SVG unit, or of a PDF point (1/72 inch)."
    )
    known_distance: str | None = Field(
        None, description="Two points of the drawing and their distance: `x0,y0,x1,y1,metres`."
    )
    layers: str | None = Field(
        None, description="Layers, groups or classes to read, separated by commas; case is ignored."
    )
    multiply: float | None = Field(
        None, gt=0, description="Factor for all lengths of a drawing or picture whose scale is false."
    )
    crop: str | None = Field(
        None,
        description="Part of a page or picture to read, such as one of several storeys: `x0,y0,x1,y1` of two opposite "
        "corners in the file's coordinates, as in `known_distance`.",
    )
    page: int | None = Field(None, ge=1, description="Page of a PDF. Default: 1.")
    y_axis: Literal["up", "down"] | None = Field(
        None, description="Direction of y in the file. Default: that of its format."
    )
    ceiling_height_m: float | None = Field(
        None, ge=1, le=20, description="Ceiling height of rooms without one in the file. Default: 2.5 m."
    )
    plan: bool | None = Field(
        None, description="True: the picture is a plan, although it looks like a photograph. Default: false."
    )


class ImportForm(_FileOptions):
    """Form fields beside the plan file; an empty field counts as left out."""

    level: str | None = Field(None, description="Name or number of the storey to read, for files with several.")
    name: str | None = Field(
        None, max_length=200, description="Name of the plan. Default: the name in the file, else that of the file."
    )


class LevelsForm(_FileOptions):
    """Form fields beside a plan file whose levels become a venue; an empty field counts as left out."""

    name: str | None = Field(
        None,
        max_length=200,
        description="Name of the venue, which also begins the names of several plans: `Duplex – Level 1`. Default: the "
        "name of the file.",
    )


class LayerAnswer(ResponseModel):
    """Use of one layer, group, class or type of entities."""

    layer: str
    entities: int
    used_as: str


class LevelAnswer(ResponseModel):
    """Storey of the file that was read."""

    name: str
    number: float | None = Field(description="0 is the ground floor; null if the file has no numbers.")
    elevation_m: float | None = Field(description="Height of its floor in the file; null if unknown.")


class OpeningTrustAnswer(ResponseModel):
    """Trust in the openings of one kind."""

    kind: OpeningKind
    trust: float = Field(ge=0, le=1, description="Probability that an opening that exists is drawn.")
    reason: str


class ScaleClueAnswer(ResponseModel):
    """Scale by one kind of parts of a drawing."""

    kind: Literal["leaf", "wall", "tread", "fixture", "area", "dimension"] = Field(
        description="Leaves of doors, walls, stairs, fixtures, or areas and dimensions that are written."
    )
    count: int
    metres_per_unit: float = Field(description="Scale by these parts alone.")
    std: float = Field(description="Standard deviation of that scale, as a share of it.")
    is_used: bool = Field(description="The scale agrees with it.")


class ImportReport(ResponseModel):
    """Report on reading a plan file."""

    format: str = Field(description="Format, detected from the content.")
    level: LevelAnswer | None = Field(description="Storey, if the file has storeys.")
    metres_per_unit: float = Field(description="Metres per unit of the file's coordinates.")
    scale_source: str = Field(description="Source of the scale.")
    is_draft: bool = Field(description="The plan was guessed from a picture or from plain lines. Check it before use.")
    layers: list[LayerAnswer] = Field(description="Use of each layer.")
    notes: list[str] = Field(description="Steps taken.")
    warnings: list[str] = Field(description="Likely mistakes, also in the plan's `warnings`.")
    unsure: list[str] = Field(description="Guesses and assumptions.")
    no_room: list[list[tuple[float, float]]] = Field(
        default=[],
        description="Outlines (m) of areas inside the drawn walls of a picture that became no room, the largest first; "
        "marked in `preview.svg`.",
    )
    opening_trust: list[OpeningTrustAnswer] = Field(
        default=[], description="Estimated `opening_trust` of the plan; empty if the file states it."
    )
    turned_deg: float = Field(
        default=0.0, description="Clockwise rotation about its centre that straightened a picture before it was read."
    )
    scale_std: float = Field(
        default=0.0, description="Standard deviation of an estimated scale, as a share of it; 0 if the scale is given."
    )
    scale_clues: list[ScaleClueAnswer] = Field(default=[], description="Parts that an estimated scale was found by.")
    scale_factor: float | None = Field(
        default=None,
        description="Factor for all lengths by which they agree with the areas or dimensions written in the drawing; "
        "the option `multiply` applies it. Null without a contradiction.",
    )
    rejected_texts: list[str] = Field(
        default=[], description="Texts that were read as areas or dimensions and not believed, with the reason."
    )
    levels: list[str] = Field(
        default=[],
        description="Levels that are drawn beside each other in the file, the largest first; the plan is one of them. "
        "Empty for a single one.",
    )


class ImportLine(BaseModel, frozen=True):
    """Line of the answer to an import: a step that begins, or at the end the answer or the problem.

    Members that do not apply are left out.
    """

    step: str | None = Field(None, description="Step that begins or goes on, such as `reading texts`.")
    done: int | None = Field(None, description="Levels of the file that are done, if the step is one of several.")
    total: int | None = Field(None, description="Levels of the file, if the step is one of several.")
    status: int | None = Field(
        None, description="HTTP status that the request would have without lines; only in the last line."
    )
    etag: str | None = Field(None, description="Header `ETag` of that answer.")
    replayed: bool | None = Field(None, description="True for the kept answer to the same `Idempotency-Key`.")
    problem: Problem | None = Field(None, description="The problem, if the status is one of failure.")
    retry_after_s: int | None = Field(
        None, description="Seconds after which the request can be sent again; left out if that does not help."
    )
