"""From the bytes of a file to plans: which format it is, says its content."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import fields, replace

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_text import read_json
from lalaloc_core.plans.model.assemble import ImportedPlan
from lalaloc_core.plans.model.limits import DEFAULT_IMPORT_LIMITS, Budget, ImportLimits
from lalaloc_core.plans.model.options import DEFAULT_OPTIONS, ImportOptions

FORMATS = ("native", "geojson", "archive", "svg", "dxf", "ifc", "pdf", "picture")
_GEOJSON_TYPES = {
    "FeatureCollection", "Feature", "Polygon", "MultiPolygon", "LineString", "MultiLineString", "Point", "MultiPoint",
    "GeometryCollection",
}  # fmt: skip
_STRANGERS = {
    b"AC10": "DWG: save it as DXF",
    b"GIF8": "GIF: save it as PNG",
    b"II*\x00": "TIFF: save it as PNG",
    b"MM\x00*": "TIFF: save it as PNG",
    b"\x1f\x8b": "gzip: unpack it",
    b"Rar!": "RAR: unpack it",
    b"7z\xbc\xaf": "7z: unpack it",
    b"{\\rtf": "RTF",
}
# Which options a format's importer looks at, besides those that all do.
_ALWAYS_HEARD = {"name", "ceiling_height_m"}
_HEARD = {
    "native": {"units", "y_axis"},
    "geojson": {"units", "y_axis", "level", "layers"},
    "archive": {"level", "layers"},
    "svg": {"units", "scale", "metres_per_pixel", "known_distance", "layers", "y_axis"},
    "dxf": {"units", "metres_per_pixel", "known_distance", "layers", "y_axis"},
    "ifc": {"level"},
    "pdf": {"scale", "metres_per_pixel", "known_distance", "page"},
    "picture": {"scale", "metres_per_pixel", "known_distance"},
}
_XML_START = re.compile(rb"\s*<(?:\?xml|!--|!DOCTYPE|[A-Za-z])")


def import_plans(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    clock: Callable[[], float] = time.monotonic,
) -> tuple[ImportedPlan, ...]:
    """The plans in a file, one for each storey, lowest first.

    Raises:
        InvalidFloorPlanError: what is wrong with the file, and what to do.
    """
    if len(content) > limits.max_bytes:
        raise InvalidFloorPlanError(
            f"the file has {len(content)} bytes, at most {limits.max_bytes} are read (max_bytes)"
        )
    budget = Budget(limits, clock)
    try:
        format = detect_format(content, limits)
        plans = _import(format, content, options, budget)
    except RecursionError as error:
        raise InvalidFloorPlanError("the file is nested too deep to be read") from error
    except MemoryError as error:
        raise InvalidFloorPlanError("the file takes more memory than there is for one") from error
    unheard = [f"'{name}' says nothing about a {format} file and was not used" for name in _unheard(format, options)]
    return tuple(
        replace(plan, report=replace(plan.report, warnings=(*unheard, *plan.report.warnings))) for plan in plans
    )


def _unheard(format: str, options: ImportOptions) -> list[str]:
    """Options that were given and that the importer of a format does not look at."""
    given = [field.name for field in fields(options) if getattr(options, field.name) != field.default]
    return [name for name in given if name not in _ALWAYS_HEARD and name not in _HEARD[format]]


def import_plan(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    clock: Callable[[], float] = time.monotonic,
) -> ImportedPlan:
    """The one plan of a file.

    Raises:
        InvalidFloorPlanError: as `import_plans`, and where a file has several storeys and the options choose none.
    """
    plans = import_plans(content, options, limits, clock)
    if len(plans) > 1:
        names = ", ".join(f"'{plan.level.name}'" for plan in plans[:12] if plan.level is not None)
        raise InvalidFloorPlanError(f"the file has {len(plans)} levels: {names}; choose one with `level`")
    return next(iter(plans))


def detect_format(content: bytes, limits: ImportLimits = DEFAULT_IMPORT_LIMITS) -> str:
    """One of `FORMATS`, by what the file holds.

    Raises:
        InvalidFloorPlanError: none of them; names what it seems to be instead.
    """
    head = content[:1024]
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not start:
        raise InvalidFloorPlanError("the file is empty")
    if head.startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")):
        return "picture"
    if b"%PDF-" in head:
        return "pdf"
    if head.startswith(b"PK\x03\x04"):
        return "archive"
    if start.startswith(b"ISO-10303-21"):
        return "ifc"
    if head.startswith(b"AutoCAD Binary DXF") or re.match(rb"(?:999\r?\n.*\r?\n\s*)*0\r?\n\s*SECTION", start):
        return "dxf"
    if start[:1] in (b"{", b"[") and not start.startswith(b"{\\rtf"):
        return _json_format(content, limits)
    if _XML_START.match(start):
        if b"<svg" in content[:65536] or b":svg" in content[:65536]:
            return "svg"
        raise InvalidFloorPlanError("the file is XML, but no SVG")
    for magic, what in _STRANGERS.items():
        if head.startswith(magic):
            raise InvalidFloorPlanError(f"the file is {what}; known are {_known()}")
    raise InvalidFloorPlanError(f"the file is of no known format; known are {_known()}")


def _import(format: str, content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Importers are loaded when they are needed: each brings a library of its own."""
    limits = budget.limits
    if format == "native":
        from lalaloc_core.plans.formats.native import import_native

        return import_native(read_json(content, limits.max_depth), options, budget)
    if format == "geojson":
        from lalaloc_core.plans.formats.geojson import import_geojson

        return import_geojson(read_json(content, limits.max_depth), options, budget)
    if format == "archive":
        return _import_archive(content, options, budget)
    if format == "svg":
        from lalaloc_core.plans.formats.svg import import_svg

        return import_svg(content, options, budget)
    if format == "dxf":
        from lalaloc_core.plans.formats.dxf import import_dxf

        return import_dxf(content, options, budget)
    if format == "ifc":
        from lalaloc_core.plans.formats.ifc import import_ifc

        return import_ifc(content, options, budget)
    if format == "pdf":
        from lalaloc_core.plans.formats.pdf import import_pdf

        return import_pdf(content, options, budget)
    from lalaloc_core.plans.picture.importing import import_picture

    return import_picture(content, options, budget)


def _import_archive(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """A zip archive is an IMDF archive, or holds one IFC model (`.ifczip`)."""
    from lalaloc_core.plans.formats.archive import read_archive

    files = read_archive(content, budget.limits, endings=(".geojson", ".json", ".ifc"))
    models = [name for name in files if name.casefold().endswith(".ifc")]
    if len(models) == 1:
        from lalaloc_core.plans.formats.ifc import import_ifc

        return import_ifc(files[models[0]], options, budget)
    from lalaloc_core.plans.formats.imdf import import_imdf

    return import_imdf(files, options, budget)


def _json_format(content: bytes, limits: ImportLimits) -> str:
    document = read_json(content, limits.max_depth)
    if isinstance(document, dict) and document.get("type") in _GEOJSON_TYPES and "rooms" not in document:
        return "geojson"
    if isinstance(document, dict):
        return "native"
    raise InvalidFloorPlanError("the JSON is a list; a plan is an object with 'rooms', GeoJSON one with 'type'")


def _known() -> str:
    return "native JSON, GeoJSON, IMDF, SVG, DXF, IFC, PDF, PNG and JPEG"
