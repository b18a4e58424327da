"""From a plan to the bytes of a file."""

from __future__ import annotations

import json
from typing import Any, Literal, get_args

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers.importing import missing_extra

ExportFormat = Literal["native", "geojson", "imdf", "dxf", "svg"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
MEDIA_TYPES: dict[ExportFormat, str] = {
    "native": "application/json",
    "geojson": "application/geo+json",
    "imdf": "application/zip",
    "dxf": "image/vnd.dxf",
    "svg": "image/svg+xml",
}
ENDINGS: dict[ExportFormat, str] = {
    "native": "json",
    "geojson": "geojson",
    "imdf": "imdf.zip",
    "dxf": "dxf",
    "svg": "svg",
}


def export_plan(plan: FloorPlan, format: str, anchor: Anchor | None = None) -> bytes:
    """The plan as a file of another tool; the same bytes for the same plan, but for DXF.

    Args:
        plan: what was understood.
        format: one of `EXPORT_FORMATS`.
        anchor: where on Earth the plan's origin lies, by default as the plan says; for IMDF and GeoJSON.

    Raises:
        InvalidFloorPlanError: an unknown format, or no anchor where one is needed.
        MissingExtraError: the package that writes the format is not installed.
    """
    try:
        return _export(plan.to_dict(), format, anchor or plan.anchor)
    except ModuleNotFoundError as error:
        raise missing_extra(error, f"writing {format}") from error


def _export(document: dict[str, Any], format: str, anchor: Anchor | None) -> bytes:
    if format == "native":
        return json.dumps(document, ensure_ascii=False, indent=1).encode()
    if format in ("geojson", "imdf"):
        from lalaloc_core.importers.exports.features import to_geojson, to_imdf

        return to_geojson(document, anchor) if format == "geojson" else to_imdf(document, anchor)
    if format in ("dxf", "svg"):
        from lalaloc_core.importers.exports.drawings import to_dxf, to_svg

        return to_dxf(document) if format == "dxf" else to_svg(document)
    raise InvalidFloorPlanError(f"format is '{format}', known are {', '.join(EXPORT_FORMATS)}")
