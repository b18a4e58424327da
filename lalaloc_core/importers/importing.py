"""From the bytes of a file to plans: which format it is, says its content."""

from __future__ import annotations

import codecs
import re
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError, MissingExtraError, SeveralLevelsError
from lalaloc_core.floorplan.json_text import read_json
from lalaloc_core.importers.model.assemble import ImportedPlan
from lalaloc_core.importers.model.limits import DEFAULT_IMPORT_LIMITS, Budget, ImportLimits
from lalaloc_core.importers.model.options import DEFAULT_OPTIONS, ImportOptions

FORMATS = ("native", "geojson", "archive", "svg", "dxf", "ifc", "pdf", "picture")
# How a refusal speaks of them.
_FORMAT_NAMES = {
    "native": "plan in the native format",
    "geojson": "GeoJSON file",
    "archive": "zip archive",
    "svg": "SVG drawing",
    "dxf": "DXF drawing",
    "ifc": "IFC model",
    "pdf": "PDF document",
    "picture": "picture",
}
_MEDIA_TYPES = {
    "native": "application/json",
    "geojson": "application/geo+json",
    "svg": "image/svg+xml",
    "dxf": "image/vnd.dxf",
    "ifc": "application/x-step",
    "pdf": "application/pdf",
}
# Which extra brings a package; the others come with `plans`.
_EXTRAS = {"ifcopenshell": "ifc"}
_PNG = b"\x89PNG\r\n\x1a\n"
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
        MissingExtraError: the package that reads its format is not installed.
    """
    if len(content) > limits.max_plan_bytes:
        raise InvalidFloorPlanError(
            f"the file has {len(content)} bytes, at most {limits.max_plan_bytes} are read (max_plan_bytes)"
        )
    budget = Budget(limits, clock)
    try:
        format, document = _recognise(content, limits)
        plans = _import(format, content, document, options, budget)
    except RecursionError as error:
        raise InvalidFloorPlanError("the file is nested too deep to be read") from error
    except MemoryError as error:
        raise InvalidFloorPlanError("the file takes more memory than there is for one") from error
    return tuple(_with_unheard(plan, format, options) for plan in plans)


def import_if_native(
    content: bytes, options: ImportOptions = DEFAULT_OPTIONS, limits: ImportLimits = DEFAULT_IMPORT_LIMITS
) -> ImportedPlan | None:
    """The plan in a file of JSON; None where that is of another format than the native one.

    For whoever leaves the other formats to another process: nothing is parsed twice, and no library loaded.

    Raises:
        InvalidFloorPlanError: no JSON, or no plan.
    """
    format, document = _recognise(content, limits)
    if format != "native":
        return None
    (plan,) = _import(format, content, document, options, Budget(limits))
    return _with_unheard(plan, format, options)


def _with_unheard(plan: ImportedPlan, format: str, options: ImportOptions) -> ImportedPlan:
    """Tell of options that were given and that the importer of a format does not look at."""
    given = [field.name for field in fields(options) if getattr(options, field.name) != field.default]
    unheard = [name for name in given if name not in _ALWAYS_HEARD and name not in _HEARD[format]]
    told = [f"'{name}' says nothing about a {format} file and was not used" for name in unheard]
    return replace(plan, report=replace(plan.report, warnings=(*told, *plan.report.warnings)))


def import_plan(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    clock: Callable[[], float] = time.monotonic,
) -> ImportedPlan:
    """The one plan of a file.

    Raises:
        InvalidFloorPlanError, MissingExtraError: as `import_plans`.
        SeveralLevelsError: the file has several storeys and the options choose none.
    """
    plans = import_plans(content, options, limits, clock)
    if len(plans) > 1:
        raise SeveralLevelsError([plan.level.name for plan in plans if plan.level is not None])
    return next(iter(plans))


def detect_format(content: bytes, limits: ImportLimits = DEFAULT_IMPORT_LIMITS) -> str:
    """One of `FORMATS`, by what the file holds.

    Raises:
        InvalidFloorPlanError: none of them; names what it seems to be instead.
    """
    return _recognise(content, limits)[0]


def _recognise(content: bytes, limits: ImportLimits) -> tuple[str, Any]:
    """The format of a file, and what it says if that is JSON, which is parsed once."""
    if is_json(content):
        document = read_json(content, limits.max_depth)
        return _json_format(document), document
    return _format_of(content), None


def _format_of(content: bytes) -> str:
    head = content[:1024]
    start = head.removeprefix(codecs.BOM_UTF8).lstrip()
    if not start:
        raise InvalidFloorPlanError("the file is empty")
    if head.startswith((_PNG, b"\xff\xd8\xff")):
        return "picture"
    if b"%PDF-" in head:
        return "pdf"
    if head.startswith(b"PK\x03\x04"):
        return "archive"
    if start.startswith(b"ISO-10303-21"):
        return "ifc"
    if head.startswith(b"AutoCAD Binary DXF") or re.match(rb"(?:999\r?\n.*\r?\n\s*)*0\r?\n\s*SECTION", start):
        return "dxf"
    if _XML_START.match(start):
        if b"<svg" in content[:65536] or b":svg" in content[:65536]:
            return "svg"
        raise InvalidFloorPlanError("the file is XML, but no SVG")
    for magic, what in _STRANGERS.items():
        if head.startswith(magic):
            raise InvalidFloorPlanError(f"the file is {what}; known are {_known()}")
    raise InvalidFloorPlanError(f"the file is of no known format; known are {_known()}")


def is_json(content: bytes) -> bool:
    """Whether a file can only be JSON, by how it begins."""
    start = content[:1024].removeprefix(codecs.BOM_UTF8).lstrip()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE))
    return wide or (start[:1] in (b"{", b"[") and not start.startswith(b"{\\rtf"))


def media_type_of(content: bytes, format: str) -> str:
    """The media type of a file that was recognised, as the report of its import tells, as a format."""
    if content.startswith(b"PK\x03\x04"):
        return "application/zip"
    if format == "picture":
        return "image/png" if content.startswith(_PNG) else "image/jpeg"
    return _MEDIA_TYPES[format]


def missing_extra(error: ModuleNotFoundError, what: str) -> MissingExtraError | ModuleNotFoundError:
    """What to raise for a package that is not installed; the error itself when the module is one of ours."""
    package = (error.name or "").partition(".")[0]
    if package in ("", "lalaloc_core"):
        return error
    return MissingExtraError(what, _EXTRAS.get(package, "plans"))


def _import(
    format: str, content: bytes, document: Any, options: ImportOptions, budget: Budget
) -> tuple[ImportedPlan, ...]:
    """Importers are loaded when they are needed: each brings a library of its own."""
    try:
        return _import_with(format, content, document, options, budget)
    except ModuleNotFoundError as error:
        raise missing_extra(error, f"reading a {_FORMAT_NAMES[format]}") from error


def _import_with(
    format: str, content: bytes, document: Any, options: ImportOptions, budget: Budget
) -> tuple[ImportedPlan, ...]:
    if format == "native":
        from lalaloc_core.importers.formats.native import import_native

        return import_native(document, options, budget)
    if format == "geojson":
        from lalaloc_core.importers.formats.geojson import import_geojson

        return import_geojson(document, options, budget)
    if format == "archive":
        return _import_archive(content, options, budget)
    if format == "svg":
        from lalaloc_core.importers.formats.svg import import_svg

        return import_svg(content, options, budget)
    if format == "dxf":
        from lalaloc_core.importers.formats.dxf import import_dxf

        return import_dxf(content, options, budget)
    if format == "ifc":
        from lalaloc_core.importers.formats.ifc import import_ifc

        return import_ifc(content, options, budget)
    if format == "pdf":
        from lalaloc_core.importers.formats.pdf import import_pdf

        return import_pdf(content, options, budget)
    from lalaloc_core.importers.picture.importing import import_picture

    return import_picture(content, options, budget)


def _import_archive(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """A zip archive is an IMDF archive, or holds one IFC model (`.ifczip`)."""
    from lalaloc_core.importers.formats.archive import read_archive

    files = read_archive(content, budget.limits, endings=(".geojson", ".json", ".ifc"))
    models = [name for name in files if name.casefold().endswith(".ifc")]
    if len(models) == 1:
        from lalaloc_core.importers.formats.ifc import import_ifc

        return import_ifc(files[models[0]], options, budget)
    from lalaloc_core.importers.formats.imdf import import_imdf

    return import_imdf(files, options, budget)


def _json_format(document: Any) -> str:
    if isinstance(document, dict) and document.get("type") in _GEOJSON_TYPES and "rooms" not in document:
        return "geojson"
    if isinstance(document, dict):
        return "native"
    what = "a list" if isinstance(document, list) else "a single value"
    raise InvalidFloorPlanError(
        f"the JSON is {what}, it must be an object: a plan with 'rooms', or GeoJSON with 'type'"
    )


def _known() -> str:
    return "native JSON, GeoJSON, IMDF, SVG, DXF, IFC, PDF, PNG and JPEG"
