"""Import of plans from the bytes of a file, and export to them. The format is detected from the content."""

from __future__ import annotations

import codecs
import re
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError, MissingExtraError, SeveralLevelsError
from lalaloc_core.file_kinds import STAND_INS, describe_file
from lalaloc_core.floorplan import DEFAULT_LIMITS, FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.json_values import json_kind, read_json
from lalaloc_core.importers.common.assemble import ImportedPlan, clean_name
from lalaloc_core.importers.common.bounded_files import member_names, read_archive
from lalaloc_core.importers.common.import_limits import DEFAULT_IMPORT_LIMITS, Budget, ImportLimits, OnStep
from lalaloc_core.importers.common.import_options import DEFAULT_OPTIONS, ImportOptions
from lalaloc_core.importers.common.import_report import Trace

_GEOJSON_TYPES = {
    "FeatureCollection", "Feature", "Polygon", "MultiPolygon", "LineString", "MultiLineString", "Point", "MultiPoint",
    "GeometryCollection",
}  # fmt: skip
_NO_MEMORY = ("bad_alloc", "Insufficient memory", "Failed to allocate", "bad allocation")
# Other files, with advice: `advice` by the last word of their description, `json` by their members, and `usdz`.
_OTHER = tomllib.loads(Path(__file__).with_name("other_files.toml").read_text(encoding="utf-8"))
_OTHER_JSON = {member: text for members, text in _OTHER["json"].items() for member in members.split()}
# Suffixes of plan files, such as .imdf.zip.
_SUFFIXES = re.compile(r"(?:(?<=.)\.imdf)?(?<=.)\.[A-Za-z0-9]{1,10}$")
# Members of a JSON document of no known format that are named.
_MAX_MEMBERS = 8
# Member of a document in the native format with several plans.
PLANS = "plans"
_SEVERAL_PLANS = re.compile(rb"(?:\xef\xbb\xbf)?\s*\{\s*\"plans\"\s*:")
# Files of IMDF, zipped IFC models and ROS maps.
_IN_ARCHIVES = (".geojson", ".json", ".ifc", ".yaml", ".yml", ".pgm", ".png")
# Members of USDZ files, and of homes of Sweet Home 3D; names that are looked at.
_USD, _HOME, _MAX_MEMBER_NAMES = (".usdc", ".usda", ".usd"), {"Home", "Home.xml"}, 5000
_OPTIONS_OF_ALL_FORMATS = {"name", "ceiling_height_m"}
# Formats with a function `write` in their module.
ExportFormat = Literal["native", "geojson", "imdf", "dxf", "svg", "ros"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
# Bytes at the start of a file that are matched with `Format.magic`.
_HEAD_BYTES = 65536
# Byte order mark and white space at the start of a text file.
_START = rb"(?:\xef\xbb\xbf)?\s*"


@dataclass(frozen=True)
class Format:
    """Description of a file format.

    Its module, `formats/<name>.py`, is loaded with the first file, because some modules need a large library. It
    defines `read(source, options, budget)`, which returns one plan per storey, and for an export format
    `write(document, anchor)`, which returns the bytes of a file. `source` is the parsed document for a JSON format, the
    files by name for an archive, and the bytes of the file for other formats.

    Attributes:
        name: name in reports, requests and on the command line; also the module's name.
        title: name in messages.
        media_type: media type of its files.
        suffix: suffix of its files, without a dot.
        options: import options that the format uses, besides `name` and `ceiling_height_m`.
        magic: pattern that matches at the start of its files; None for JSON and for archives by their members.
        keys: members that recognise a JSON document of the format; without them it is GeoJSON or native.
        extra: optional dependency of this package that installs its libraries.
    """

    name: str
    title: str
    media_type: str
    suffix: str
    options: frozenset[str]
    magic: re.Pattern[bytes] | None = None
    keys: frozenset[str] = frozenset()
    extra: str = "plans"

    def call(self, function: Literal["read", "write"], *arguments: Any) -> Any:
        """Return the plans that the format's module reads from a file, or the file that it writes.

        Raises:
            InvalidFloorPlanError: the file is invalid or exceeds a limit.
            MissingExtraError: a library of the format is not installed.
        """
        try:
            module = import_module(f"lalaloc_core.importers.formats.{self.name}")
            return getattr(module, function)(*arguments)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in ("", "lalaloc_core"):
                raise
            activity = "reading" if function == "read" else "writing"
            raise MissingExtraError(f"{activity} {self.title}", self.extra) from error


def _xml(element: str) -> re.Pattern[bytes]:
    """Return a pattern for XML files that begin with an element, after declarations and comments."""
    name = re.escape(element.encode())
    return re.compile(_START + rb"(?=<(?:\?xml|!--|!DOCTYPE|[A-Za-z])).*?(?:<|:)" + name, re.DOTALL)


def _format(name: str, title: str, media_type: str, suffix: str, options: str, **more: Any) -> Format:
    return Format(name, title, media_type, suffix, frozenset(options.split()), **more)


_GML, _OSM = "application/gml+xml", "application/vnd.openstreetmap.data+xml"
_SCALE = "metres_per_pixel known_distance multiply"
_DXF = rb"AutoCAD Binary DXF|" + _START + rb"(?:999\r?\n[^\n]*\n\s*)*0\r?\n\s*SECTION"
# A picture of a map, or its YAML file.
_ROS = rb"P[25]\s|(?:[a-z_]+:[^\n]*\n|\s|#[^\n]*\n)*image:"
_FORMATS = (
    _format("native", "native JSON", "application/json", "json", "units y_axis level"),
    _format("geojson", "GeoJSON", "application/geo+json", "geojson", "units y_axis level layers"),
    _format("osm", "OpenStreetMap (XML, Overpass JSON)", _OSM, "osm", "level layers", magic=_xml("osm"),
            keys=frozenset({"elements"})),
    _format("roomplan", "RoomPlan", "application/json", "json", "level", keys=frozenset({"walls", "doors", "windows"})),
    _format("valetudo", "Valetudo map (JSON or PNG)", "application/json", "json", "",
            keys=frozenset({"pixelSize", "layers"})),
    _format("imdf", "IMDF", "application/zip", "imdf.zip", "level layers", magic=re.compile(rb"PK\x03\x04")),
    _format("ros", "ROS map (zip archive of YAML and PGM)", "application/zip", "map.zip", "metres_per_pixel",
            magic=re.compile(_ROS)),
    _format("sweethome3d", "Sweet Home 3D", "application/zip", "sh3d", "level"),
    _format("dxf", "DXF", "image/vnd.dxf", "dxf", f"units layers y_axis crop {_SCALE}",
            magic=re.compile(_DXF, re.DOTALL)),
    _format("dwg", "DWG (with a converter)", "image/vnd.dwg", "dwg", f"units layers y_axis crop {_SCALE}",
            magic=re.compile(rb"AC10\d\d")),
    _format("indoorgml", "IndoorGML", _GML, "gml", "units level", magic=_xml("IndoorFeatures")),
    _format("svg", "SVG", "image/svg+xml", "svg", f"units scale layers y_axis crop {_SCALE}", magic=_xml("svg")),
    _format("ifc", "IFC", "application/x-step", "ifc", "level", magic=re.compile(_START + rb"ISO-10303-21"),
            extra="ifc"),
    _format("picture", "PNG and JPEG", "image/png", "png", f"scale crop level plan {_SCALE}",
            magic=re.compile(rb"\x89PNG\r\n\x1a\n|\xff\xd8\xff")),
    _format("pdf", "PDF", "application/pdf", "pdf", f"scale page crop level {_SCALE}",
            magic=re.compile(rb".{0,1019}%PDF-", re.DOTALL)),
)  # fmt: skip
FORMATS: Mapping[str, Format] = {record.name: record for record in _FORMATS}


def import_plans(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    clock: Callable[[], float] = time.process_time,
    *,
    building: str | None = None,
    trace: Trace | None = None,
    on_step: OnStep | None = None,
) -> tuple[ImportedPlan, ...]:
    """Return the plans in a file, one per storey, lowest first.

    `building` names a plan that has no name, and plans of several storeys, unless the options have one: "Duplex – Level
    1". Several plans in the native format keep their own names. `trace` receives what is read from a drawing or a
    picture, also of a file that is refused. `on_step` is called with every step as it begins.

    Raises:
        InvalidFloorPlanError: the file is invalid or exceeds a limit.
        MissingExtraError: a library of its format is not installed.
    """
    if len(content) > limits.max_plan_bytes:
        raise InvalidFloorPlanError(
            f"the file has {len(content)} bytes; the limit is {limits.max_plan_bytes} (max_plan_bytes); "
            "export a single storey"
        )
    budget = Budget(limits, clock, trace, on_step, len(content))
    try:
        budget.begin("opening the file")
        format, source = _open(content, limits)
        budget.begin(f"reading {format.title}")
        plans = format.call("read", source, options, budget)
    except RecursionError as error:
        raise InvalidFloorPlanError(
            f"the file is nested too deep; the limit is {limits.max_depth} levels (max_depth)"
        ) from error
    except InvalidFloorPlanError as error:
        hints = [hint for hint in budget.hints if hint not in error.reason]
        raise InvalidFloorPlanError("; ".join([error.reason, *hints]), room=error.room) from error
    except InvalidInputError:
        raise
    except Exception as error:
        # Errors of C++ have no class.
        if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY):
            raise InvalidFloorPlanError(
                "the file needs more memory than is available (LALALOC_IMPORT_MEMORY_BYTES in the service); export a "
                "single storey, or a smaller picture"
            ) from error
        # OpenCV is loaded with pictures only, so its errors are known by their module.
        if type(error).__module__ == "cv2":
            named = f" of '{building}'" if building else ""
            raise InvalidFloorPlanError(
                f"the picture{named} cannot be read: measuring its lines failed; check the scale (metres_per_pixel, "
                "known_distance or scale), crop it to one storey (crop), or save it in another size"
            ) from error
        raise
    several, building = len(plans) > 1, options.name or building
    named = plans if building is None else [
        plan if "name" in plan.document and (format.name == "native" or not several)
        else _rename(plan, building, by_level=several)
        for plan in plans
    ]  # fmt: skip
    return tuple(_with_option_warnings(plan, format, options) for plan in named)


def import_plan(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    *,
    building: str | None = None,
    on_step: OnStep | None = None,
) -> ImportedPlan:
    """Return the only plan in a file, or the largest of storeys that are drawn beside each other.

    `building` names it if the file does not, `on_step` is as for `import_plans`.

    Raises:
        InvalidFloorPlanError: the file is invalid or exceeds a limit.
        SeveralLevelsError: the file has several storeys and the option `level` is not set.
    """
    plans = without_storeys_beside(import_plans(content, options, limits, building=building, on_step=on_step))
    if len(plans) > 1:
        raise SeveralLevelsError([plan.level.name for plan in plans if plan.level is not None])
    return next(iter(plans))


def without_storeys_beside(plans: Sequence[ImportedPlan]) -> Sequence[ImportedPlan]:
    """Return the largest of storeys that are drawn beside each other, whose report names all; else all plans."""
    largest = next(iter(plans[0].report.levels), None)
    return [plan for plan in plans if plan.level is not None and plan.level.name == largest] or plans


def import_if_native(
    content: bytes,
    options: ImportOptions = DEFAULT_OPTIONS,
    limits: ImportLimits = DEFAULT_IMPORT_LIMITS,
    *,
    building: str | None = None,
) -> ImportedPlan | None:
    """Return the plan in a file, None if the file is not in the native format or has several plans.

    `building` names the plan if the file does not. No library of another format is loaded, so a caller can leave the
    other formats to a worker process.
    """
    if not is_json(content):
        return None
    document = read_json(content, limits.max_depth, limits.max_json_values)
    if _json_format(document).name != "native" or PLANS in document:
        return None
    (plan,) = import_plans(content, options, limits, building=building)
    return plan


def export_plan(plan: FloorPlan, format: str, anchor: Anchor | None = None) -> bytes:
    """Return a plan as a file. Equal plans give equal bytes, whenever and wherever they are written.

    `anchor` places the plan's origin on Earth for IMDF and GeoJSON; by default it is the plan's own.
    """
    if format not in EXPORT_FORMATS:
        raise InvalidFloorPlanError(f"format is '{format}'; set it to one of {', '.join(EXPORT_FORMATS)}")
    return FORMATS[format].call("write", plan.to_dict(), anchor or plan.anchor)


def detect_format(content: bytes, limits: ImportLimits = DEFAULT_IMPORT_LIMITS) -> str:
    """Return the name of a file's format, a key of `FORMATS`. Every zip archive counts as IMDF."""
    if is_json(content):
        return _json_format(read_json(content, limits.max_depth, limits.max_json_values)).name
    return _format_by_magic(content).name


def building_name(file_name: str | None) -> str | None:
    """Return the name of a building from the name of its file: "Duplex" for "Duplex.ifc"; None for an empty name."""
    last = re.split(r"[/\\]", file_name or "")[-1]
    return clean_name(_SUFFIXES.sub("", last))


def is_json(content: bytes) -> bool:
    """Return whether a file starts like JSON and like no other format."""
    start = content[:1024].removeprefix(codecs.BOM_UTF8).lstrip()
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE))
    return is_wide or (start[:1] in (b"{", b"[") and not start.startswith(b"{\\rtf"))


def begins_with_plans(content: bytes) -> bool:
    """Return whether a file begins like a document in the native format with several plans."""
    return _SEVERAL_PLANS.match(content) is not None


def detect_media_type(content: bytes, format: str) -> str:
    """Return the media type of a file whose import reported `format`."""
    if content.startswith(b"PK\x03\x04"):
        return "application/zip"
    if content.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    # A picture can have a map of another format as a text.
    return FORMATS["picture" if content.startswith(b"\x89PNG") else format].media_type


def _open(content: bytes, limits: ImportLimits) -> tuple[Format, Any]:
    """Return the format of a file and the source that its `read` expects."""
    if is_json(content):
        document = read_json(content, limits.max_depth, limits.max_json_values)
        return _json_format(document), document
    format = _format_by_magic(content)
    if format.name == "picture":
        from lalaloc_core.importers.formats.valetudo import map_in_picture

        found = map_in_picture(content, limits)
        return (format, content) if found is None else (_json_format(found), found)
    if format.name != "imdf":
        return format, content
    from lalaloc_core.importers.formats.ros import YAML_SUFFIXES

    names = member_names(content, _MAX_MEMBER_NAMES)
    if any(name.casefold().endswith(_USD) for name in names):
        raise InvalidFloorPlanError(_OTHER["usdz"])
    # Homes have a member for every model of a piece of furniture.
    if _HOME.intersection(names):
        return FORMATS["sweethome3d"], read_archive(content, limits, suffixes=("home.xml",))
    files = read_archive(content, limits, suffixes=_IN_ARCHIVES)
    if any(name.casefold().endswith(YAML_SUFFIXES) for name in files):
        return FORMATS["ros"], files
    # A zip archive with a single IFC model is an .ifczip file.
    models = [name for name in files if name.casefold().endswith(".ifc")]
    return (FORMATS["ifc"], files[models[0]]) if len(models) == 1 else (format, files)


def _json_format(document: Any) -> Format:
    if not isinstance(document, dict):
        raise InvalidFloorPlanError(
            f"the JSON is {json_kind(document)}; it must be an object: a plan with 'rooms', or GeoJSON with 'type'"
        )
    for format in FORMATS.values():
        if format.keys and format.keys <= document.keys():
            return format
    kind = str(document.get("type"))
    other = next((key for key in _OTHER_JSON if key in document or kind.startswith(key)), "")
    if ("rooms" in document or PLANS in document) and not other:
        return FORMATS["native"]
    if kind in _GEOJSON_TYPES:
        return FORMATS["geojson"]
    if other:
        raise InvalidFloorPlanError(f"the file is {_OTHER_JSON[other]}")
    members = ", ".join(f"'{key[:50]}'" for key in list(document)[:_MAX_MEMBERS]) or "none"
    raise InvalidFloorPlanError(
        f"the JSON has the members {members}, of no known format; the native format has 'rooms' or 'plans', "
        "GeoJSON 'type', OpenStreetMap 'elements', RoomPlan 'walls', 'doors' and 'windows', and Valetudo "
        "'pixelSize' and 'layers'"
    )


def _format_by_magic(content: bytes) -> Format:
    head = content[:_HEAD_BYTES]
    for format in FORMATS.values():
        if format.magic is not None and format.magic.match(head):
            return format
    start = head.removeprefix(codecs.BOM_UTF8).lstrip()
    if not start:
        raise InvalidFloorPlanError("the file is empty; export it again")
    kind = describe_file(content)
    if kind is not None:
        advice = STAND_INS.get(kind) or _OTHER["advice"].get(kind.rpartition(" ")[2], "convert it")
        found = f"{kind}, which cannot be read: {advice}"
    elif start.startswith(b"<"):
        found = "XML of no known kind: save a drawing as SVG or DXF, a map as OSM or IndoorGML"
    else:
        found = "in no known format"
    titles = ", ".join(format.title for format in FORMATS.values())
    raise InvalidFloorPlanError(f"the file is {found}; supported formats are {titles}")


def _rename(plan: ImportedPlan, name: str, *, by_level: bool = False) -> ImportedPlan:
    """Return a plan with a name; one of several storeys is named "Duplex – Level 1"."""
    level = f" – {plan.level.title}" if by_level and plan.level is not None else ""
    longest = DEFAULT_LIMITS.max_name_length
    name = f"{name[: max(longest - len(level), 0)]}{level}"[:longest]
    checked = plan.checked and (plan.checked[0], replace(plan.checked[1], name=name))
    return replace(plan, document={"name": name} | plan.document | {"name": name}, checked=checked)


def _with_option_warnings(plan: ImportedPlan, format: Format, options: ImportOptions) -> ImportedPlan:
    """Add a warning for every option that is set although the format does not use it."""
    given = [field.name for field in fields(options) if getattr(options, field.name) != field.default]
    unused = [name for name in given if name not in _OPTIONS_OF_ALL_FORMATS | format.options]
    warnings = [f"the option '{name}' was ignored: it does not apply to {format.title}" for name in unused]
    return replace(plan, report=replace(plan.report, warnings=(*warnings, *plan.report.warnings)))
