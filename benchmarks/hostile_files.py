"""Small plan files of models, maps and pictures that are made to take an import worker's time or memory."""

from __future__ import annotations

import io
import json
import math
import random
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from lalaloc_core.importers import ImportOptions

LARGEST_NUMBER = 1e308
NONE, _DRAFT = ImportOptions(), ImportOptions(metres_per_pixel=0.01)
Point = tuple[float, float]


@dataclass(frozen=True)
class HostilePlan:
    """Kind of hostile files: `make` returns one of about a size in bytes."""

    format: str
    title: str
    make: Callable[[int], bytes]
    options: ImportOptions


def plan(format: str, title: str, make: Callable[[int], bytes], options: ImportOptions = NONE) -> HostilePlan:
    return HostilePlan(format, title, make, options)


def star(points: int, size: float = 20.0) -> list[Point]:
    """Return a ring whose edges all cross one another."""
    step = 2.0 * math.pi * ((points - 1) // 2) / points
    return [(size * math.cos(k * step), size * math.sin(k * step)) for k in range(points)]


def circle(points: int, radius: float) -> list[Point]:
    """Return a ring that is nearly round."""
    return [(radius * math.cos(math.tau * k / points), radius * math.sin(math.tau * k / points)) for k in range(points)]


def chords(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return lines across a square, a quarter of whose pairs cross."""
    rng = random.Random(count)
    return [((0.0, size * rng.random()), (size, size * rng.random())) for _ in range(count)]


def lattice(count: int, size: float = 20.0) -> list[tuple[Point, Point]]:
    """Return upright and level lines, half of whose pairs cross."""
    places = [size * k / count for k in range(count // 2)]
    return [((x, 0.0), (x, 0.5 * size)) for x in places] + [((0.0, x), (0.5 * size, x)) for x in places]


def boxes(count: int, apart: float = 1e-3, size: float = 5.0) -> list[list[Point]]:
    """Return squares that nearly coincide."""
    corners = ((0.0, 0.0), (size, 0.0), (size, size), (0.0, size))
    return [[(x + apart * k, y + apart * k) for x, y in corners] for k in range(count)]


def rounded(points: Sequence[Point], digits: int = 3) -> list[list[float]]:
    """Return points as lists of rounded coordinates."""
    return [[round(x, digits), round(y, digits)] for x, y in points]


def stars(size: int, points: int, bytes_each: int) -> list[list[Point]]:
    """Return stars beside one another."""
    count = max(size // (bytes_each * points), 1)
    shape = star(points, 2.0)
    return [[(x + 5.0 * (k % 30), y + 5.0 * (k // 30)) for x, y in shape] for k in range(count)]


def _json(document: Any) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode()


def _zip(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


_IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
# A floor's own frame lies on its side: its y is the scan's z.
_FLOOR = [1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1]


def _roomplan(walls: Iterable[Any] = (), floors: Iterable[Any] = (), **more: Any) -> bytes:
    return _json({"walls": list(walls), "doors": [], "windows": [], "floors": list(floors)} | more)


def _scanned_floor(points: Sequence[Point]) -> dict[str, Any]:
    return {"polygonCorners": [[*point, 0] for point in rounded(points)], "transform": _FLOOR}


def _scanned_wall(start: Point, end: Point) -> dict[str, Any]:
    length = math.dist(start, end)
    c, s = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    x, y = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    transform = [c, 0, -s, 0, 0, 1, 0, 0, s, 0, c, 0, x, 1.25, -y, 1]
    return {"dimensions": [round(length, 3), 2.5, 0], "transform": [round(value, 3) for value in transform]}


def _huge_roomplan(_size: int) -> bytes:
    wall = {"dimensions": [LARGEST_NUMBER, 2.5, 0], "transform": _IDENTITY}
    return _roomplan([wall, {"dimensions": [3, 2.5, 0], "transform": [LARGEST_NUMBER] * 16}])


def _sections(size: int) -> bytes:
    count = size // 160
    sections = [{"label": "livingRoom", "center": [99, 0, 99]}] * count
    return _roomplan((), [_scanned_floor(box) for box in boxes(count, 6.0)], sections=sections)


_MAP = b"image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n"
_PGM = b"P5\n100 100\n255\n" + bytes([254]) * 10_000


def _ros(yaml: bytes, picture: bytes = _PGM) -> bytes:
    return _zip({"map.yaml": yaml, "map.pgm": picture})


def _aliases(size: int) -> bytes:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, min(size // 60, 60))]
    return _ros(_MAP + "\n".join([*lines, f"origin: *a{len(lines) - 1}", ""]).encode())


def _merges(size: int) -> bytes:
    lines = ["a0: &a0 {x: 1, y: 2}"]
    lines += [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}]}}" for k in range(1, min(size // 70, 60))]
    return _ros(_MAP + "\n".join([*lines, ""]).encode())


def _noise(side: int) -> bytes:
    rng = random.Random(side)
    return bytes(255 * rng.randrange(2) for _ in range(side * side))


def _noise_picture(side: int) -> Image.Image:
    return Image.frombytes("L", (side, side), _noise(side))


def _png(gray: Image.Image) -> bytes:
    stream = io.BytesIO()
    gray.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _tiled(pattern: Image.Image) -> Image.Image:
    """Return a picture of 36 megapixels that repeats a square pattern, which takes few bytes."""
    times = -(-6000 // pattern.width)
    return Image.fromarray(np.tile(np.asarray(pattern), (times, times))[:6000, :6000])


def _checkerboard(cell: int) -> Image.Image:
    pattern = Image.new("L", (2 * cell, 2 * cell), 255)
    for x, y in ((0, 0), (cell, cell)):
        pattern.paste(0, (x, y, x + cell, y + cell))
    return _tiled(pattern)


def _grid(pitch: int, line: int) -> Image.Image:
    pattern = Image.new("L", (pitch, pitch), 255)
    pattern.paste(0, (0, 0, line, pitch))
    pattern.paste(0, (0, 0, pitch, line))
    return _tiled(pattern)


def _osm(ways: Sequence[Sequence[Point]], more: str = "") -> bytes:
    lines, number = ["<osm>"], 0
    for way in ways:
        refs = []
        for x, y in way:
            number += 1
            lines.append(f'<node id="{number}" lat="{y * 1e-5:.8f}" lon="{x * 1e-5:.8f}"/>')
            refs.append(f'<nd ref="{number}"/>')
        lines.append(f'<way id="{number}">{"".join([*refs, refs[0]])}<tag k="indoor" v="room"/></way>')
    return "\n".join([*lines, more, "</osm>"]).encode()


def _multipolygons(size: int) -> bytes:
    points = size // 400
    relation = f'<member type="way" ref="{points}" role="outer"/><tag k="type" v="multipolygon"/>'
    relations = [f'<relation id="{k}">{relation}<tag k="indoor" v="room"/></relation>' for k in range(size // 200)]
    return _osm([circle(points, 20.0)], "".join(relations))


def _geojson(rings: Sequence[Sequence[Point]], **properties: Any) -> bytes:
    features = []
    for ring in rings:
        geometry = {"type": "Polygon", "coordinates": [rounded([*ring, ring[0]])]}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return _json({"type": "FeatureCollection", "units": "m", "features": features})


def _geojson_holes(size: int) -> bytes:
    holes = [rounded([*box, box[0]]) for box in boxes(size // 60, 1e-3, 1.0)]
    outer = [[-9, -9], [99, -9], [99, 99], [-9, 99], [-9, -9]]
    return _json({"type": "Polygon", "coordinates": [outer, *holes], "units": "m"})


def _geojson_lines(size: int) -> bytes:
    lines = [{"type": "LineString", "coordinates": rounded(chord, 2)} for chord in chords(size // 110)]
    features = [{"type": "Feature", "properties": {"kind": "door"}, "geometry": line} for line in lines]
    (box,) = boxes(1, size=20.0)
    room = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[*box, box[0]]]}}
    return _json({"type": "FeatureCollection", "units": "m", "features": [room, *features]})


def _native(rings: Sequence[Sequence[Point]], openings: Sequence[Any] = ()) -> bytes:
    rooms = [{"polygon": rounded(ring)} for ring in rings]
    doors = [{"kind": "door", "line": rounded(line)} for line in openings]
    return _json({"ceiling_height_m": 2.5, "rooms": rooms, "openings": doors})


_GML = "http://www.opengis.net/gml/3.2"


def _indoorgml(faces: Sequence[Sequence[Point]]) -> bytes:
    rings = []
    for face in faces:
        positions = " ".join(f"{x:.3f} {y:.3f} 0.000" for x, y in [*face, face[0]])
        rings.append(
            f"<gml:exterior><gml:LinearRing><gml:posList>{positions}</gml:posList></gml:LinearRing></gml:exterior>"
        )
    return (
        f'<IndoorFeatures xmlns:gml="{_GML}"><CellSpace gml:id="a"><cellSpaceGeometry>{"".join(rings)}'
        "</cellSpaceGeometry></CellSpace></IndoorFeatures>"
    ).encode()


MODELS = (
    plan("roomplan", "numbers of 1e308", _huge_roomplan),
    plan("roomplan", "a floor that crosses itself", lambda s: _roomplan((), [_scanned_floor(star(s // 18))])),
    plan("roomplan", "stars of 15 corners", lambda s: _roomplan((), map(_scanned_floor, stars(s, 15, 24)))),
    plan("roomplan", "walls that cross", lambda s: _roomplan([_scanned_wall(*c) for c in chords(s // 120)])),
    plan("roomplan", "a lattice of walls", lambda s: _roomplan([_scanned_wall(*c) for c in lattice(s // 120)])),
    plan("roomplan", "floors that coincide", lambda s: _roomplan((), map(_scanned_floor, boxes(s // 140)))),
    plan("roomplan", "sections of no room", _sections),
    plan("ros", "nested aliases", _aliases),
    plan("ros", "nested merge keys", _merges),
    plan("ros", "nested lists", lambda s: _ros(_MAP + b"a: " + b"[" * min(s, 60_000))),
    plan("ros", "nested blocks", lambda s: _ros(_MAP + b"a:\n " + b"- " * min(s // 2, 30_000))),
    plan("ros", "a number in base 60", lambda s: _ros(_MAP[:17] + b"resolution: 1" + b":1" * min(s // 2, 30_000))),
    plan("ros", "keys", lambda s: _ros(_MAP + b"".join(b"a%d: {b: [1, 2]}\n" % k for k in range(2800)))),
    plan("ros", "noise", lambda s: _ros(_MAP, b"P5\n%d %d\n255\n" % ((side := math.isqrt(s * 8),) * 2) + _noise(side))),
    plan(
        "ros",
        "checkerboard of 36 megapixels",
        lambda _: _zip({"map.yaml": _MAP.replace(b"pgm", b"png"), "map.png": _png(_checkerboard(20))}),
    ),
    plan(
        "ros", "empty map of 36 megapixels", lambda s: _ros(_MAP, b"P5\n6000 6000\n255\n" + bytes([254]) * 36_000_000)
    ),
    plan("osm", "latitude nan", lambda s: _osm([boxes(1)[0]]).replace(b'lat="0.00000000"', b'lat="nan"')),
    plan("osm", "longitude 1e308", lambda s: _osm([boxes(1)[0]]).replace(b'lon="0.00000000"', b'lon="1e308"')),
    plan("osm", "a room that crosses itself", lambda s: _osm([star(s // 75)])),
    plan("osm", "stars of 15 corners", lambda s: _osm(stars(s, 15, 75))),
    plan("osm", "one way in many multipolygons", _multipolygons),
    plan("osm", "rooms that coincide", lambda s: _osm(boxes(s // 400, 0.1))),
    plan("geojson", "numbers of 1e308", lambda s: _geojson([[(0.0, 0.0), (LARGEST_NUMBER, 0.0), (0.0, 5.0)]])),
    plan("geojson", "a room that crosses itself", lambda s: _geojson([star(s // 16)])),
    plan("geojson", "stars of 15 corners", lambda s: _geojson(stars(s, 15, 20))),
    plan("geojson", "rooms that coincide", lambda s: _geojson(boxes(s // 150))),
    plan("geojson", "columns that coincide", lambda s: _geojson([star(5, 9.0), *boxes(s // 170)], kind="column")),
    plan("geojson", "holes that coincide", _geojson_holes),
    plan("geojson", "doors that cross", _geojson_lines),
    plan("geojson", "200 levels", lambda s: _geojson(boxes(s // 200, 6.0), level=";".join(map(str, range(200))))),
    plan("native", "a room that crosses itself", lambda s: _native([star(s // 16)])),
    plan("native", "stars of 15 corners", lambda s: _native(stars(s, 15, 20))),
    plan("native", "rooms that coincide", lambda s: _native(boxes(s // 60))),
    plan("native", "doors that cross", lambda s: _native(boxes(1, size=20.0), chords(s // 60))),
    plan("indoorgml", "a cell that crosses itself", lambda s: _indoorgml([star(s // 20)])),
    plan("indoorgml", "faces that coincide", lambda s: _indoorgml(boxes(s // 180))),
    plan("indoorgml", "numbers of 1e308", lambda s: _indoorgml([[(0.0, 0.0), (LARGEST_NUMBER, 0.0), (0.0, 5.0)]])),
)
PICTURES = (
    plan("picture", "white, 36 megapixels", lambda s: _png(Image.new("L", (6000, 6000), 255)), _DRAFT),
    plan("picture", "checkerboard of 20 pixels", lambda s: _png(_checkerboard(20)), _DRAFT),
    plan("picture", "checkerboard of 8 pixels", lambda s: _png(_checkerboard(8)), _DRAFT),
    plan("picture", "lattice of 100 pixels", lambda s: _png(_grid(100, 20)), _DRAFT),
    plan("picture", "lattice of 300 pixels", lambda s: _png(_grid(300, 20)), _DRAFT),
    plan("picture", "lattice of two lines", lambda s: _png(_grid(60, 3)), _DRAFT),
    plan("picture", "noise", lambda s: _png(_noise_picture(math.isqrt(8 * s))), _DRAFT),
    plan("picture", "coarse noise", lambda s: _png(_noise_picture(300).resize((6000, 6000), 0)), _DRAFT),
)
