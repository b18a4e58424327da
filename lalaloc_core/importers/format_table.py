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


@dataclass(frozen=True, kw_only=True)
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
        magic: pattern that matches at the start of its files; None for JSON.
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
        """Return a plan as a file of this format.

        Raises:
            InvalidFloorPlanError: the plan lacks something that the format requires.
            MissingExtraError: a library of the format is not installed.
        """
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


_DRAWN_SCALE = {"metres_per_pixel", "known_distance"}

FORMATS: Mapping[str, Format] = {
    record.name: record
    for record in (
        Format(
            name="native",
            title="native JSON",
            media_type="application/json",
            suffix="json",
            options=frozenset({"units", "y_axis", "level"}),
        ),
        Format(
            name="geojson",
            title="GeoJSON",
            media_type="application/geo+json",
            suffix="geojson",
            options=frozenset({"units", "y_axis", "level", "layers"}),
        ),
        Format(
            name="osm",
            title="OpenStreetMap (XML, Overpass JSON)",
            media_type="application/vnd.openstreetmap.data+xml",
            suffix="osm",
            options=frozenset({"level", "layers"}),
            magic=_xml("osm"),
            keys=frozenset({"elements"}),
        ),
        Format(
            name="roomplan",
            title="RoomPlan",
            media_type="application/json",
            suffix="json",
            options=frozenset({"level"}),
            keys=frozenset({"walls", "doors", "windows"}),
        ),
        Format(
            name="imdf",
            title="IMDF",
            media_type="application/zip",
            suffix="imdf.zip",
            options=frozenset({"level", "layers"}),
            magic=re.compile(rb"PK\x03\x04"),
        ),
        Format(
            name="ros",
            title="ROS map (zip archive of YAML and PGM)",
            media_type="application/zip",
            suffix="map.zip",
            options=frozenset({"metres_per_pixel"}),
            # A picture of a map, or its YAML file.
            magic=re.compile(rb"P[25]\s|(?:[a-z_]+:[^\n]*\n|\s|#[^\n]*\n)*image:"),
        ),
        Format(
            name="dxf",
            title="DXF",
            media_type="image/vnd.dxf",
            suffix="dxf",
            options=frozenset({"units", "layers", "y_axis", *_DRAWN_SCALE}),
            magic=re.compile(
                rb"AutoCAD Binary DXF|" + _START + rb"(?:999\r?\n[^\n]*\n\s*)*0\r?\n\s*SECTION", re.DOTALL
            ),
        ),
        Format(
            name="dwg",
            title="DWG (with a converter)",
            media_type="image/vnd.dwg",
            suffix="dwg",
            options=frozenset({"units", "layers", "y_axis", *_DRAWN_SCALE}),
            magic=re.compile(rb"AC10\d\d"),
        ),
        Format(
            name="indoorgml",
            title="IndoorGML",
            media_type="application/gml+xml",
            suffix="gml",
            options=frozenset({"units", "level"}),
            magic=_xml("IndoorFeatures"),
        ),
        Format(
            name="svg",
            title="SVG",
            media_type="image/svg+xml",
            suffix="svg",
            options=frozenset({"units", "scale", "layers", "y_axis", *_DRAWN_SCALE}),
            magic=_xml("svg"),
        ),
        Format(
            name="ifc",
            title="IFC",
            media_type="application/x-step",
            suffix="ifc",
            options=frozenset({"level"}),
            magic=re.compile(_START + rb"ISO-10303-21"),
            extra="ifc",
        ),
        Format(
            name="picture",
            title="PNG and JPEG",
            media_type="image/png",
            suffix="png",
            options=frozenset({"scale", *_DRAWN_SCALE}),
            magic=re.compile(rb"\x89PNG\r\n\x1a\n|\xff\xd8\xff"),
        ),
        Format(
            name="pdf",
            title="PDF",
            media_type="application/pdf",
            suffix="pdf",
            options=frozenset({"scale", "page", *_DRAWN_SCALE}),
            magic=re.compile(rb".{0,1019}%PDF-", re.DOTALL),
        ),
    )
}
