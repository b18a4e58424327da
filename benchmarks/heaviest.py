"""Heaviest accepted input of every route, and hostile ones, for `neighbours.py` and the tests of growth.

`LOADS` has at least one entry for every operation in `openapi.yaml`; `missing_routes` names those without. The work of
an entry scales with a size, so that the benchmark sends the largest one and the tests count operations of small ones.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any
from urllib.parse import urlencode

import yaml
from PIL import Image

from benchmarks.harness import Answer, Caller, form
from examples.launch import ROOT
from examples.truth import read_poses
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import EXPORT_FORMATS, ImportLimits, export_plan

# Plans with the most vertices, and with the most rooms and openings, that are accepted by default, as for `building`.
VERTICES_PLAN, ROOMS_PLAN = "500 rooms × 190 walls", "10,000 rooms × 20,000 openings"
PLANS = {VERTICES_PLAN: (500, 190), ROOMS_PLAN: (10_000, 4, 2)}
# Photographs of a sequence and of a batch.
_PHOTOGRAPHS = 10
_ANCHOR = {"latitude": 48.1372, "longitude": 11.5756, "north_deg": 25.0}


@dataclass(frozen=True)
class Stored:
    """Resources of a tenant that the work of a route needs."""

    plan_id: str
    plan_etag: str
    album: str
    venue_id: str
    venue_etag: str
    member_ids: Sequence[str]

    @classmethod
    def of(cls, caller: Caller, plan_id: str, venue_id: str, venue_etag: str, member_ids: Sequence[str]) -> Stored:
        """Return a plan and a venue that are ready, and store an album of the plan."""
        plan_etag = caller.send("GET", f"/floorplans/{plan_id}").etag
        return cls(plan_id, plan_etag, store_album(caller, plan_id), venue_id, venue_etag, member_ids)


Work = Callable[[Caller, Stored, int], None]


@dataclass(frozen=True)
class Load:
    """Work of one tenant: the requests of one round, proportional to a size, by default that of the largest input.

    `routes` are as in `openapi.yaml`; `refusals` refuse the input itself, besides too many requests. The other tenant
    pins small albums, if `beside_albums`, instead of queries.
    """

    routes: tuple[str, ...]
    title: str
    work: Work
    size: int = 0
    plan: str = VERTICES_PLAN
    connections: int = 8
    refusals: frozenset[int] = frozenset()
    beside_albums: bool = False


def missing_routes() -> list[str]:
    """Return method and path of the operations in `openapi.yaml` without an entry in `LOADS`."""
    paths = yaml.safe_load((ROOT / "openapi.yaml").read_text(encoding="utf-8"))["paths"]
    documented = {f"{method.upper()} {path}" for path, operations in paths.items() for method in operations}
    return sorted(documented - {route for load in LOADS for route in load.routes})


def building(rooms: int, corners: int = 4, openings_per_room: int = 0) -> dict[str, Any]:
    """Return a plan of equal rooms in rows, squares of 1 m or round with a diameter of 2 m."""
    columns = math.ceil(math.sqrt(rooms))
    pitch = 1.0 if corners == 4 else 2.2
    places = [(pitch * (number % columns), pitch * (number // columns)) for number in range(rooms)]
    turns = [2.0 * math.pi * number / corners for number in range(corners)]
    ring = [(0, 0), (1, 0), (1, 1), (0, 1)] if corners == 4 else [(math.cos(t), math.sin(t)) for t in turns]
    lines = [((0.1, 0.0), (0.9, 0.0)), ((0.0, 0.1), (0.0, 0.9))][:openings_per_room]

    def moved(points: Sequence[tuple[float, float]], x: float, y: float) -> list[list[float]]:
        return [[round(x + a, 9), round(y + b, 9)] for a, b in points]

    plan = {"name": "building", "ceiling_height_m": 2.5, "camera_height_m": 1.5, "anchor": _ANCHOR}
    doors = [{"kind": "door", "line": moved(line, *place)} for place in places for line in lines]
    return plan | {"rooms": [{"polygon": moved(ring, *place)} for place in places], "openings": doors}


def home(number: int) -> dict[str, Any]:
    """Return a plan of one room of random size; the same for the same number."""
    rng = random.Random(number)
    width, depth = rng.uniform(3.0, 6.0), rng.uniform(2.2, 4.5)
    room = {"polygon": [[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]]}
    return {"name": f"home {number:05d}", "ceiling_height_m": 2.5, "camera_height_m": 1.5, "rooms": [room]}


def created_id(answer: Answer) -> str:
    if answer.status != 201:
        raise RuntimeError(f"status {answer.status}: {answer.content[:300]!r}; the benchmark needs 201")
    return answer.json()["id"]


def _create(caller: Caller, path: str, content: bytes, media: str = "application/json") -> str:
    """Create a resource and return its path; empty if it is refused."""
    answer = caller.send("POST", path, content, media)
    return f"{path}/{answer.json()['id']}" if answer.status == 201 else ""


def store_venue(caller: Caller, homes: int) -> tuple[str, str, list[str]]:
    """Store homes and a venue of them; return its id and entity tag, and the ids of the homes."""
    ids = [created_id(caller.send("POST", "/floorplans", _body(home(number)))) for number in range(homes)]
    answer = caller.send("POST", "/venues", _venue(ids))
    return created_id(answer), answer.etag, ids


def store_album(caller: Caller, plan_id: str, photographs: int = _PHOTOGRAPHS) -> str:
    """Store an album of spheres, wait until it is solved, and return its path; empty if it is refused."""
    if album := _create(caller, "/albums", _body({"floorplan_id": plan_id})):
        for first in range(0, photographs, _PHOTOGRAPHS):
            caller.send("POST", f"{album}/photographs", *_spheres(first=first))
        caller.send("GET", f"{album}/events")
    return album


def _body(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode()


def _venue(plan_ids: Sequence[str], name: str = "venue") -> bytes:
    return _body({"name": name, "plans": [{"floorplan_id": plan_id, "level": 0} for plan_id in plan_ids]})


@cache
def _sphere() -> bytes:
    return read_poses()[0].picture.read_bytes()


def _spheres(*fields: tuple[str, str], first: int = 0) -> tuple[bytes, str]:
    """Return a form with spheres; bytes after the picture make each another one."""
    return form(fields, tuple(("photo", _sphere() + str(first + number).encode()) for number in range(_PHOTOGRAPHS)))


@cache
def _building_body(rooms: int, corners: int, openings_per_room: int = 0) -> bytes:
    return _body(building(rooms, corners, openings_per_room))


@cache
def _diagonals_body(rooms: int) -> bytes:
    """Return a plan with openings whose bounding boxes contain all walls."""
    plan = building(rooms)
    side = math.ceil(math.sqrt(rooms))
    lines = [[[0.001 * number, 0.0], [side, side]] for number in range(5 * rooms)]
    return _body(plan | {"openings": [{"kind": "passage", "line": line} for line in lines]})


@cache
def _combs_body(rooms: int) -> bytes:
    """Return a plan of combs; every other one is transposed, so that its teeth cross those of its neighbours."""
    tooth = ((0.01, 0.1), (0.01, 48.0), (0.02, 48.0), (0.02, 0.1))
    teeth = [(k + x, y) for k in range(48) for x, y in tooth]
    comb = [(0.0, 0.0), (0.0, 0.1), *teeth, (48.0, 0.1), (48.0, 0.0)]
    rings = [[(x + 0.03 * k, y + 0.03 * k) for x, y in comb] for k in range(rooms)]
    return _rooms_body([[(y, x) for x, y in ring] if k % 2 else ring for k, ring in enumerate(rings)])


@cache
def _slivers_body(rooms: int) -> bytes:
    """Return a plan of corridors of millimetres; the bounding box of each, which is searched for poses, is a square."""
    side, width = 19.9, 0.013
    ring = [(0.0, 0.0), (width, 0.0), (width + side, side), (side, side)]
    return _rooms_body([[(0.05 * k + x, y) for x, y in ring] for k in range(rooms)])


def _rooms_body(rings: Sequence[Sequence[tuple[float, float]]]) -> bytes:
    rooms = [{"polygon": [[round(x, 3), round(y, 3)] for x, y in ring]} for ring in rings]
    return _body({"ceiling_height_m": 2.5, "rooms": rooms})


@cache
def _svg(kibibytes: int) -> bytes:
    """Return a drawing of one room with comments."""
    drawing = export_plan(FloorPlan.from_dict(home(0)), "svg")
    end = drawing.rindex(b"</svg>")
    return drawing[:end] + kibibytes * (b"<!--" + 1017 * b"x" + b"-->") + drawing[end:]


def _unended_string(size: int) -> bytes:
    return b'"' + b'\\"' * (size // 2)


def _grey_jpeg(width: int, height: int) -> bytes:
    """Return a grey progressive JPEG."""
    buffer = io.BytesIO()
    Image.new("L", (width, height), 90).save(buffer, "JPEG", progressive=True)
    return buffer.getvalue()


@cache
def _jpeg(kilopixels: int) -> bytes:
    """Return a grey progressive JPEG, twice as wide as high."""
    height = math.isqrt(500 * kilopixels)
    return _grey_jpeg(2 * height, height)


@cache
def _scans(count: int) -> bytes:
    """Return a grey progressive JPEG of 98 megapixels with a number of scans."""
    content = _grey_jpeg(14_000, 7_000)
    begin = content.rindex(b"\xff\xc4", 0, content.rindex(b"\xff\xda"))
    return content[:-2] + (count - 6) * content[begin:-2] + content[-2:]


@cache
def _padded_picture(size: int) -> bytes:
    """Return the example photograph with comments of some bytes in total."""
    comment = b"\xff\xfe\xff\xff" + bytes(2**16 - 3)
    picture = _sphere()
    return picture[:2] + comment * max(size // len(comment), 0) + picture[2:]


@cache
def _commented_picture(count: int) -> bytes:
    """Return the example photograph with empty comments."""
    picture = _sphere()
    return picture[:2] + b"\xff\xfe\0\2" * count + picture[2:]


_names = itertools.count()


def _get(path: str, *, conditional: bool = False, **query: object) -> Work:
    """Return the work of one GET; values of the query that are None are the size."""

    def work(caller: Caller, stored: Stored, size: int) -> None:
        address = path.format(floorplan_id=stored.plan_id, venue_id=stored.venue_id)
        text = urlencode({name: size if value is None else value for name, value in query.items()})
        etag = "" if not conditional else stored.venue_etag if "venue_id" in path else stored.plan_etag
        caller.send("GET", f"{address}?{text}" if text else address, etag=etag)

    return work


def _post_plan(
    title: str,
    size: int,
    content: Callable[[int], bytes],
    media: str = "application/json",
    *,
    routes: tuple[str, ...] = ("POST /floorplans",),
    deletes: bool = True,
    refusals: frozenset[int] = frozenset(),
) -> Load:
    """Return the load of storing a plan, and by default of deleting it, before its pose grid is prepared."""

    def work(caller: Caller, _stored: Stored, size: int) -> None:
        plan = _create(caller, "/floorplans", content(size), media)
        if plan and deletes:
            caller.send("DELETE", plan)

    return Load(routes, title, work, size, refusals=refusals)


def _put_plan(caller: Caller, stored: Stored, size: int) -> None:
    caller.send("PUT", f"/floorplans/{stored.plan_id}", _building_body(size, 4, 2))


def _hall(area_m2: int) -> bytes:
    side_m = math.sqrt(area_m2)
    polygon = [[0.0, 0.0], [side_m, 0.0], [side_m, side_m], [0.0, side_m]]
    return _body({"ceiling_height_m": 3.0, "rooms": [{"polygon": polygon}]})


def _follow_events(caller: Caller, _stored: Stored, size: int) -> None:
    if plan := _create(caller, "/floorplans", _hall(size)):
        caller.send("GET", f"{plan}/events")


def _localise(picture: Callable[[int], bytes] = lambda _size: _sphere(), **fields: str) -> Work:
    """Return the work of a query; without a heading, so that all are searched."""

    def work(caller: Caller, stored: Stored, size: int) -> None:
        values = {name: value.format(plan=stored.plan_id, venue=stored.venue_id) for name, value in fields.items()}
        caller.send("POST", "/localise", *form(tuple(values.items()), (("photo", picture(size)),)))

    return work


def _sequence(*, venue: bool = False, views: bool = False) -> Work:
    """Return the work of a sequence of spheres, `size` tenths of a megabyte in total, or of `size` views of a turn."""

    def work(caller: Caller, stored: Stored, size: int) -> None:
        files = _PHOTOGRAPHS * (("photo", _padded_picture(size * 10**5 // _PHOTOGRAPHS)),)
        if views:
            pictures = [(ROOT / f"examples/turn_{number}.jpg").read_bytes() for number in range(1, 5)]
            files = tuple(("photo", pictures[number % len(pictures)]) for number in range(size))
        place = ("venue_id", stored.venue_id) if venue else ("floorplan_id", stored.plan_id)
        caller.send("POST", "/localise/sequence", *form((place, ("motion", "turn")), files))

    return work


def _batch(caller: Caller, stored: Stored, _size: int) -> None:
    caller.send("POST", "/localise/batch", *_spheres(("floorplan_id", stored.plan_id)))


def _post_venue(caller: Caller, stored: Stored, _size: int) -> None:
    if venue := _create(caller, "/venues", _venue(stored.member_ids)):
        caller.send("DELETE", venue)


@cache
def _levels_body(rooms: int) -> tuple[bytes, str]:
    """Return a form with a file of rooms on a tenth as many levels, at most as many as are accepted."""
    levels = min(max(rooms // 10, 1), ImportLimits().max_levels)
    features = []
    for number in range(rooms):
        x = 1.1 * (number // levels)
        ring = [[x, 0.0], [x + 1.0, 0.0], [x + 1.0, 1.0], [x, 1.0], [x, 0.0]]
        properties = {"indoor": "room", "level": str(number % levels)}
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    content = _body({"type": "FeatureCollection", "units": "m", "features": features})
    return form((("ceiling_height_m", "2.5"),), (("file", content),))


def _delete_with_plans(caller: Caller, venue: str) -> None:
    plans = caller.send("GET", f"{venue}/plans?limit=500").json()["plans"]
    caller.send("DELETE", venue)
    for plan in plans:
        caller.send("DELETE", f"/floorplans/{plan['floorplan_id']}")


def _post_levels(caller: Caller, _stored: Stored, size: int) -> None:
    if venue := _create(caller, "/venues", *_levels_body(size)):
        _delete_with_plans(caller, venue)


@cache
def _homes_body(homes: int) -> tuple[bytes, str]:
    """Return a form with a file of many plans."""
    return form((), (("file", _body({"plans": [home(number) for number in range(homes)]})),))


def _extend_venue(caller: Caller, _stored: Stored, size: int) -> None:
    body = _homes_body(size)
    if path := _create(caller, "/venues", _venue([])):
        caller.send("PATCH", path, *body)
        _delete_with_plans(caller, path)


def _put_venue(caller: Caller, stored: Stored, _size: int) -> None:
    caller.send("PUT", f"/venues/{stored.venue_id}", _venue(stored.member_ids, f"venue {next(_names)}"))


def _change_and_search_venue(caller: Caller, stored: Stored, size: int) -> None:
    caller.send("PATCH", f"/venues/{stored.venue_id}", _body({"name": f"venue {next(_names)}"}))
    _localise(venue_id="{venue}")(caller, stored, size)


def _read_and_delete_answer(caller: Caller, stored: Stored, _size: int) -> None:
    fields = (("floorplan_id", stored.plan_id), ("include", "posterior"))
    answer = caller.send("POST", "/localise", *form(fields, (("photo", _sphere()),)))
    if answer.status == 200:
        path = f"/answers/{answer.json()['answer_id']}"
        caller.send("GET", path)
        caller.send("DELETE", path)


def _follow_session(caller: Caller, stored: Stored, _size: int, *, venue: bool = False) -> None:
    place = {"venue_id": stored.venue_id} if venue else {"floorplan_id": stored.plan_id}
    if path := _create(caller, "/sessions", _body(place)):
        sphere = (("projection", "equirectangular"),)
        for fields in (sphere, (*sphere, ("forward_m", "1"), ("turn_deg", "0"))):
            caller.send("POST", f"{path}/photographs", *form(fields, (("photo", _sphere()),)))
        caller.send("GET", path)
        caller.send("DELETE", path)


def _pin_album(caller: Caller, stored: Stored, size: int) -> None:
    if not (album := store_album(caller, stored.plan_id, size)):
        return
    caller.send("GET", album)
    page = caller.send("GET", f"{album}/photographs")
    if page.status == 200 and (photographs := page.json()["photographs"]):
        path = f"{album}/photographs/{photographs[0]['id']}"
        caller.send("PATCH", path, _body({"correction": {"elsewhere": True}}))
        caller.send("GET", path)
        caller.send("DELETE", path)
    caller.send("DELETE", album)


def _copy_album(caller: Caller, stored: Stored, _size: int) -> None:
    caller.send("POST", f"{stored.album}/copies", *_spheres())


def _tiny_chunks(caller: Caller, _stored: Stored, size: int) -> None:
    """Send a body in chunks of one byte."""
    head = f"POST /localise HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Type: {_EMPTY_FORM}"
    caller.send_bytes(head, b"1\r\nx\r\n" * size)


def _many_parts(caller: Caller, _stored: Stored, size: int) -> None:
    """Send a form of empty parts."""
    part = b'--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n\r\n'
    caller.send("POST", "/localise", part * size, _EMPTY_FORM)


def _nearly_ended_form(caller: Caller, _stored: Stored, size: int) -> None:
    """Send a form with a file of lines that nearly end it."""
    part = b'--b\r\nContent-Disposition: form-data; name="file"; filename="p"\r\n\r\n'
    caller.send("POST", "/floorplans", part + b"\r\n--" * size, _EMPTY_FORM)


def _partial_body(caller: Caller, _stored: Stored, size: int) -> None:
    """Send a part of a body, and wait for the service to give up."""
    head = f"POST /localise HTTP/1.1\r\nContent-Length: {size}\r\nContent-Type: {_EMPTY_FORM}"
    caller.send_bytes(head, b"--b")


def _unread_answer(caller: Caller, _stored: Stored, size: int) -> None:
    """Ask for a file that is larger than a socket's buffers, and do not read it."""
    if path := _create(caller, "/floorplans", _body(home(0)) + b" " * (1024 * size)):
        caller.send_bytes(f"GET {path}/original HTTP/1.1", hold_s=2.0)
        caller.send("DELETE", path)


def _administer(caller: Caller, _stored: Stored, _size: int) -> None:
    document = {"tenant": "new", "name": "n" * 200, "scopes": ["metrics", "read", "localise", "write"]}
    if path := _create(caller, "/admin/keys", _body(document)):
        caller.send("POST", f"{path}/rotation", _body({"overlap_s": 0}))
        caller.send("GET", path)
        caller.send("DELETE", path)
    caller.send("PATCH", "/admin/tenants/new", _body({"cpu_share": 1.0}))


def _read(
    path: str, title: str = "", size: int = 0, plan: str = VERTICES_PLAN, *, conditional: bool = False, **query: object
) -> Load:
    """Return the load of one GET, by default titled like the plan; values of the query that are None are the size."""
    work = _get(path, conditional=conditional, **query)
    return Load((f"GET {path}",), (title or plan) + ", conditional" * conditional, work, size, plan)


_PLAN, _VENUE = "/floorplans/{floorplan_id}", "/venues/{venue_id}"
_SESSION, _KEY = "/sessions/{session_id}", "/admin/keys/{key_id}"
_ALBUM = "/albums/{album_id}"
_PINNED = f"{_ALBUM}/photographs/{{photograph_id}}"
_ALBUMS = ("POST /albums", f"GET {_ALBUM}/events", f"GET {_ALBUM}", f"DELETE {_ALBUM}")
_PHOTOGRAPHS_OF_ALBUM = f"POST {_ALBUM}/photographs", f"GET {_ALBUM}/photographs"
_SESSIONS = ("POST /sessions", f"POST {_SESSION}/photographs")
_TOO_LONG = frozenset({422})
_EMPTY_FORM = "multipart/form-data; boundary=b"
# Statuses of bodies of too many events, and of bodies that do not arrive.
_TOO_MANY_EVENTS, _TOO_LATE = frozenset({400}), frozenset({400, 408})
_localising, _sequencing = (partial(Load, (f"POST /localise{path}",)) for path in ("", "/sequence"))
LOADS = (
    _read("/floorplans", "pages of 500", 500, limit=None),
    _read(_PLAN),
    _read(_PLAN, conditional=True),
    _read(f"{_PLAN}/original"),
    *(_read(f"{_PLAN}/export", f"{kind}, {VERTICES_PLAN}", format=kind) for kind in EXPORT_FORMATS),
    _read(f"{_PLAN}/preview.svg"),
    _read(f"{_PLAN}/mesh.glb", plan=ROOMS_PLAN),
    _read(f"{_PLAN}/localisability", plan=ROOMS_PLAN),
    _read(f"{_PLAN}/localisability.svg"),
    _read(f"{_PLAN}/layout", plan=ROOMS_PLAN),
    Load(
        (f"GET {_PLAN}/events", "POST /floorplans"),
        "64 streams of plans in preparation",
        _follow_events,
        9_600,
        connections=64,
    ),
    _post_plan("homes of one room", 0, lambda _size: _body(home(0)), routes=("POST /floorplans", f"DELETE {_PLAN}")),
    _post_plan(VERTICES_PLAN, 500, lambda size: _building_body(size, 190)),
    _post_plan(ROOMS_PLAN, 10_000, lambda size: _building_body(size, 4, 2)),
    _post_plan("2,000 rooms × 10,000 diagonal openings", 2_000, _diagonals_body, refusals=_TOO_LONG),
    _post_plan("SVG of 39 MB", 39_000, _svg, "image/svg+xml"),
    _post_plan("halls of 1,600 m², whose pose grids are prepared", 1_600, _hall, deletes=False),
    _post_plan("24 rooms, crossing combs", 24, _combs_body, refusals=_TOO_LONG),
    _post_plan("500 slivers across a square", 500, _slivers_body, deletes=False, refusals=_TOO_LONG),
    _post_plan("JSON that is one string without an end", 2_000_000, _unended_string, refusals=_TOO_LONG),
    Load((f"PUT {_PLAN}",), ROOMS_PLAN, _put_plan, 10_000),
    Load(("POST /venues", f"DELETE {_VENUE}"), "{homes} homes", _post_venue),
    Load(("POST /venues",), "file of 200 levels × 50 rooms", _post_levels, 10_000),
    Load((f"PATCH {_VENUE}",), "file of 200 homes", _extend_venue, 200),
    _read("/venues", "pages of 500", 500, limit=None),
    _read(_VENUE, "{homes} homes"),
    _read(_VENUE, "{homes} homes", conditional=True),
    Load((f"PUT {_VENUE}",), "{homes} homes", _put_venue),
    Load((f"PATCH {_VENUE}",), "{homes} homes, then a query in the venue", _change_and_search_venue),
    _read(f"{_VENUE}/plans", "{homes} homes, pages of 500", 500, limit=None),
    _localising(VERTICES_PLAN, _localise(floorplan_id="{plan}"), connections=16),
    _localising("{homes} homes", _localise(venue_id="{venue}"), connections=16),
    _localising("JPEG of 98 megapixels", _localise(_jpeg, floorplan_id="{plan}", projection="equirectangular"), 98_000),
    _localising("JPEG of 400 scans", _localise(_scans, floorplan_id="{plan}"), 400, refusals=_TOO_LONG),
    _localising(
        "JPEG of 5 million empty comments",
        _localise(_commented_picture, floorplan_id="{plan}"),
        5_000_000,
        refusals=_TOO_LONG,
    ),
    Load(("POST /localise/batch",), f"10 photographs, {VERTICES_PLAN}", _batch),
    _sequencing(f"10 photographs, {VERTICES_PLAN}", _sequence()),
    _sequencing("18 photographs of a phone's turn", _sequence(views=True), 18, connections=4),
    _sequencing("10 photographs, {homes} homes", _sequence(venue=True)),
    _sequencing("10 photographs of 100 MB in total", _sequence(), 1_000, connections=44),
    Load(
        (*_SESSIONS, f"GET {_SESSION}", f"DELETE {_SESSION}"),
        f"two photographs, {ROOMS_PLAN}",
        _follow_session,
        plan=ROOMS_PLAN,
    ),
    Load(_SESSIONS, "two photographs, {homes} homes", partial(_follow_session, venue=True)),
    _read("/albums", "pages of 500", 500, limit=None),
    Load(
        (*_ALBUMS, *_PHOTOGRAPHS_OF_ALBUM, f"GET {_PINNED}", f"PATCH {_PINNED}", f"DELETE {_PINNED}"),
        f"album of 500 spheres, {VERTICES_PLAN}",
        _pin_album,
        500,
    ),
    Load(("POST /albums",), "album of 500 spheres; beside it albums of 10", _pin_album, 500, beside_albums=True),
    Load((f"POST {_ALBUM}/copies",), f"10 spheres, {VERTICES_PLAN}", _copy_album),
    _localising("body in chunks of 1 byte", _tiny_chunks, 200_000, refusals=_TOO_MANY_EVENTS),
    _localising("form of 20,000 empty parts", _many_parts, 20_000, refusals=_TOO_MANY_EVENTS),
    Load(
        ("POST /floorplans",),
        "form of 500,000 lines that nearly end it",
        _nearly_ended_form,
        500_000,
        refusals=_TOO_MANY_EVENTS | _TOO_LONG,
    ),
    _localising("bodies that do not arrive", _partial_body, 100_000, connections=60, refusals=_TOO_LATE),
    Load((f"GET {_PLAN}/original",), "answers that are not read", _unread_answer, 2_048, connections=64),
    Load(("GET /model/{file}",), "encoder of spheres", _get("/model/image_encoder.onnx")),
    Load(
        ("GET /answers/{answer_id}", "DELETE /answers/{answer_id}"),
        f"{VERTICES_PLAN}, posterior",
        _read_and_delete_answer,
    ),
    Load(
        ("POST /admin/keys", f"POST {_KEY}/rotation", f"GET {_KEY}", f"DELETE {_KEY}", "PATCH /admin/tenants/{tenant}"),
        "keys and limits",
        _administer,
    ),
    *(_read(f"/admin/{name}", "pages of 500", 500, limit=None) for name in ("keys", "tenants", "audit")),
    *(_read(f"/{name}", "–") for name in ("healthz", "readyz", "metrics", "limits", "usage")),
)
