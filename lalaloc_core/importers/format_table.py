"""Table of all file formats: recognition, options, and the module that reads and writes each.

To add a format, write `formats/<name>.py` with a function `read`, and add a record here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, get_args

from lalaloc_core.errors import MissingExtraError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers.common.assemble import ImportedPlan
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_options import ImportOptions

# Formats with a function `write` in their module.
ExportFormat = Literal["native", "geojson", "imdf", "dxf", "svg", "ros"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
# Bytes at the start of a file that are matched with `Format.magic`.
HEAD_BYTES = 65536
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

    def read(self, source: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
        """Return the plans in a file, one per storey, lowest first.

        Raises:
            InvalidFloorPlanError: the file is invalid or exceeds a limit.
            MissingExtraError: a library of the format is not installed.
        """
        return self._call("read", "reading", source, options, budget)

    def write(self, document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
        """Return a plan as a file of this format."""
        return self._call("write", "writing", document, anchor)

    def _call(self, function: str, activity: str, *arguments: Any) -> Any:
        try:
            module = import_module(f"lalaloc_core.importers.formats.{self.name}")
            return getattr(module, function)(*arguments)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in ("", "lalaloc_core"):
                raise
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
    _format("picture", "PNG and JPEG", "image/png", "png", f"scale crop {_SCALE}",
            magic=re.compile(rb"\x89PNG\r\n\x1a\n|\xff\xd8\xff")),
    _format("pdf", "PDF", "application/pdf", "pdf", f"scale page crop {_SCALE}",
            magic=re.compile(rb".{0,1019}%PDF-", re.DOTALL)),
)  # fmt: skip
FORMATS: Mapping[str, Format] = {record.name: record for record in _FORMATS}
