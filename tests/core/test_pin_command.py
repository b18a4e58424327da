"""`lalaloc pin`: a folder of photographs and a plan, with the shipped model; and copies with their place."""

import csv
import io
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pypdfium2
import pytest
from defusedxml.ElementTree import fromstring
from PIL import ExifTags, Image

from lalaloc_core.cli import main
from lalaloc_core.draw.canvas import document, words
from lalaloc_core.draw.pdf import draw_pdf
from lalaloc_core.draw.pins import report_notes
from lalaloc_core.localise.album.solve import _MISFIT_WARNING
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.photograph.placed_copy import Place, placed_copy
from lalaloc_core.shown_text import no_formula, printable
from tests.core.fault_photographs import FOLDER
from tests.core.taken import PHONE, jpeg, sphere, take
from tests.painted import picture_file
from tests.strategies import present

EXAMPLES = Path(__file__).parents[2] / "examples"
PLACE = Place(room="Küche", level="Ground & first", latitude=-33.8568, longitude=151.2153, direction_deg=271.24)


@pytest.fixture(scope="module")
def pinned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("pin")
    folder, out = root / "visit", root / "out"
    folder.mkdir()
    for name in ("kitchen", "study", "phone"):
        shutil.copy(EXAMPLES / f"{name}.jpg", folder)
    shutil.copy(EXAMPLES / "study.jpg", folder / "study \udcff\x07.jpg")
    (folder / "broken.jpg").write_bytes(b"\xff\xd8 no picture")
    (folder / "notes.txt").write_text("hello")
    plan = json.loads((EXAMPLES / "flat.json").read_text()) | {"north_deg": 30.0}
    plan["anchor"] = {"latitude": 48.2, "longitude": 16.37}
    (root / "flat.json").write_text(json.dumps(plan))
    assert main(["pin", str(root / "flat.json"), str(folder), "--out", str(out)]) == 0
    return folder, out


def test_folder_is_pinned_with_a_sentence_on_what_is_not(pinned: tuple[Path, Path]) -> None:
    pins = json.loads((pinned[1] / "pins.json").read_text())
    rooms = {entry["photograph"]: entry["room"] for entry in pins["photographs"]}
    places = {
        "kitchen.jpg": "kitchen",
        "phone.jpg": "living room",
        "study.jpg": "study",
        "study \ufffd\ufffd.jpg": "study",
    }
    assert rooms == {"broken.jpg": None} | places
    notes = " ".join(pins["notes"])
    assert "'broken.jpg' is set aside: the photograph is not a readable JPEG" in notes
    assert "copies of other files, which have the same pin: 1" in notes
    assert "files that are no JPEG, PNG, WebP or HEIC pictures, such as 'notes.txt', were left out: 1" in notes
    assert pins["counts"]["set_aside"] == 1


def test_tables_and_drawings_have_every_pin(pinned: tuple[Path, Path]) -> None:
    _, out = pinned
    rows = list(csv.DictReader(io.StringIO((out / "pins.csv").read_text())))
    assert [row["state"] == "set_aside" for row in rows] == [True, False, False, False, False]
    assert {(row["room_confidence"] == row["confidence"]) for row in rows} == {True}
    assert max(float(row["room_confidence"]) for row in rows) > 0.8
    collection = json.loads((out / "pins.geojson").read_text())
    assert len(collection["features"]) == 4
    longitude, latitude = collection["features"][0]["geometry"]["coordinates"]
    assert abs(latitude - 48.2) < 1e-3
    assert abs(longitude - 16.37) < 1e-3
    assert (out / "plan.svg").read_text().count('class="pin ') == 4
    # The plan, three rooms, and what was set aside.
    assert len(pypdfium2.PdfDocument(out / "report.pdf")) == 5


def test_text_of_the_report_can_be_selected(pinned: tuple[Path, Path]) -> None:
    report = pypdfium2.PdfDocument(pinned[1] / "report.pdf")
    pages = [page.get_textpage().get_text_range() for page in report]
    assert all(name in pages[0] for name in ("bathroom", "corridor", "3 sure, 1 set aside"))
    assert any("kitchen.jpg" in page and page.startswith("kitchen") for page in pages)
    assert "broken.jpg" in pages[-1]


def test_warnings_about_the_album_are_lines_of_the_report() -> None:
    count, *lines = report_notes({"sure": 0, "uncertain": 3}, None, [_MISFIT_WARNING.format(60.0)])
    assert count == "3 uncertain"
    assert " ".join(lines) == _MISFIT_WARNING.format(60.0)
    assert max(map(len, lines)) <= 105


@pytest.mark.slow
def test_photographs_on_their_side_are_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, camera = tmp_path / "visit", Perspective.of_hfov(640, 480, math.radians(67.3))
    folder.mkdir()
    for number, heading_deg in enumerate((135.0, 315.0)):
        upright = take(sphere("living_room"), camera, heading_deg=heading_deg)
        (folder / f"{number}.jpg").write_bytes(jpeg(np.rot90(upright).copy(), PHONE))
    command = ["pin", str(EXAMPLES / "flat.json"), str(folder), "--out", str(tmp_path / "out"), "--no-copies"]
    assert main(command) == 0
    out, errors = capsys.readouterr()
    assert "warning: 0.jpg and 1 more: the photograph may lie on its side" in errors
    assert re.search(r"heading °\s+room right\s+within 1 m\s+state", out)


def test_selected_text_lies_over_its_picture() -> None:
    name = "Küche 厨房 ж"
    turned = f'<g transform="translate(500 600) rotate(90)">{words(0, 0, "turned", 40)}</g>'
    parts = [words(100, 200, name, 40), words(900, 300, "end", 40, anchor="end"), turned]
    page = pypdfium2.PdfDocument(draw_pdf([document(1000, 1000, "Page", parts)], 72))[0]
    text = page.get_textpage()
    assert text.get_text_range().splitlines()[:2] == [name, "end"]
    ink = np.asarray(page.render(scale=1).to_pil().convert("L")) < 128
    for word in (name, "end", "turned"):
        index, count = present(text.search(word).get_next())
        boxes = [text.get_charbox(number) for number in range(index, index + count)]
        left, bottom = (min(box[side] for box in boxes) for side in (0, 1))
        right, top = (max(box[side] for box in boxes) for side in (2, 3))
        rows, columns = np.nonzero(
            ink[round(1000 - top) - 9 : round(1000 - bottom) + 9, round(left) - 9 : round(right) + 9]
        )
        drawn = columns.min(), rows.min(), columns.max(), rows.max()
        np.testing.assert_allclose(drawn, (9, 9, 9 + right - left, 9 + top - bottom), atol=6)


def test_originals_stay_and_copies_have_the_same_pixels(pinned: tuple[Path, Path]) -> None:
    folder, out = pinned
    for name in ("kitchen.jpg", "phone.jpg"):
        assert (folder / name).read_bytes() == (EXAMPLES / name).read_bytes()
        with Image.open(out / "photographs" / name) as copy, Image.open(folder / name) as original:
            np.testing.assert_array_equal(np.asarray(copy), np.asarray(original))
            gps = copy.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        assert gps[ExifTags.GPS.GPSLatitudeRef] == "N"
        assert ExifTags.GPS.GPSImgDirection in gps


@pytest.mark.parametrize(
    ("folder", "out", "message"),
    [
        ("photographs", ".", "would write beside '.*photographs/kitchen.jpg', which is read"),
        ("visit", "visit", "would write beside '.*visit/kitchen.jpg', which is read"),
        ("visit", ".", "would write beside '.*flat.json', which is read"),
        ("visit", "used", "'.*used' has files; choose a new folder, or add --replace"),
    ],
)
def test_no_file_is_overwritten_unasked(
    folder: str, out: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (tmp_path / folder / "kitchen.jpg", tmp_path / "flat.json", tmp_path / "used" / "pins.json"):
        path.parent.mkdir(exist_ok=True)
        shutil.copy(EXAMPLES / path.name if path.name != "pins.json" else EXAMPLES / "flat.json", path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert main(["pin", str(tmp_path / "flat.json"), str(tmp_path / folder), "--out", str(tmp_path / out)]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.slow
def test_copies_are_not_written_through_links(pinned: tuple[Path, Path]) -> None:
    original, copy = (folder / "kitchen.jpg" for folder in (pinned[0], pinned[1] / "photographs"))
    plan, table = pinned[0].parent / "flat.json", pinned[1] / "pins.csv"
    for written, read in ((copy, original), (table, plan)):
        written.unlink()
        written.hardlink_to(read)
    before = plan.read_bytes()
    assert main(["pin", str(plan), str(pinned[0]), "--out", str(pinned[1]), "--replace"]) == 0
    assert plan.read_bytes() == before
    assert original.read_bytes() == (EXAMPLES / "kitchen.jpg").read_bytes() != copy.read_bytes()


def test_shown_names_hold_no_formulas_or_control_characters() -> None:
    texts = ("=1", "-1", " ＝1", "a=1", "a; +1", "")
    assert [no_formula(text) for text in texts] == ["'=1", "'-1", "' ＝1", "a=1", "a;' +1", ""]
    assert printable("K\udcffche\x07\ufffe.jpg") == "K\ufffdche\ufffd\ufffd.jpg"
    copy, _ = placed_copy(_picture("JPEG"), replace(PLACE, room="K\ufffeche"))
    with Image.open(io.BytesIO(copy)) as picture:
        assert picture.getxmp()["xmpmeta"]["RDF"]["Description"]["Location"] == "K\ufffdche"


@pytest.mark.slow
def test_a_new_revision_lists_what_moved(
    pinned: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = pinned
    plan = json.loads((EXAMPLES / "flat.json").read_text())
    for room in plan["rooms"]:
        room["polygon"] = [[x + 2.0, y] for x, y in room["polygon"]]
    for opening in plan["openings"]:
        opening["line"] = [[x + 2.0, y] for x, y in opening["line"]]
    plan.pop("fixtures", None)
    (tmp_path / "moved.json").write_text(json.dumps(plan))
    command = ["pin", str(tmp_path / "moved.json"), str(folder), "--out", str(tmp_path / "out"), "--no-copies"]
    assert main([*command, "--previous", str(out / "pins.json")]) == 0
    assert "'kitchen.jpg' moved by 2.0 m in 'kitchen'" in capsys.readouterr().err
    assert not (tmp_path / "out" / "photographs").exists()
    assert not (tmp_path / "out" / "pins.geojson").exists()


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "has no photographs"),
        ({"a.txt": b"x"}, "has no photographs"),
        ({"a.jpg": b"x"}, "none of 1 photographs can be read; the first: the photograph is not a readable JPEG"),
        ({f"{number}.jpg": b"x" for number in range(501)}, "501 photographs are too many; the limit is 500"),
    ],
)
def test_folder_without_usable_photographs_is_refused(
    files: dict[str, bytes], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "visit"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    assert main(["pin", str(EXAMPLES / "flat.json"), str(folder), "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("plan", ["missing.json", "visit"])
def test_missing_plan_is_named(plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "visit").mkdir()
    (tmp_path / "visit" / "a.jpg").write_bytes(b"x")
    command = ["pin", str(tmp_path / plan), str(tmp_path / "visit"), "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert f"{plan}' cannot be read" in capsys.readouterr().err


def _picture(kind: str, **options: Any) -> bytes:
    rng = np.random.default_rng(0)
    return picture_file(rng.integers(0, 256, (96, 128, 3), np.uint8), kind, **options)


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_copy_states_the_place_and_keeps_everything_else(kind: str) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.DateTimeOriginal: "2026:05:01 12:00:00"}
    content = _picture(kind, exif=exif.tobytes())
    first, sidecar = placed_copy(content, PLACE)
    assert sidecar is None
    # Twice, as for a copy of a copy: nothing is written double.
    again, _ = placed_copy(first, PLACE)
    with Image.open(io.BytesIO(again)) as copy, Image.open(io.BytesIO(content)) as original:
        np.testing.assert_array_equal(np.asarray(copy), np.asarray(original))
        found, xmp = copy.getexif(), copy.getxmp()["xmpmeta"]["RDF"]["Description"]
    gps = found.get_ifd(ExifTags.IFD.GPSInfo)
    assert found[ExifTags.Base.Make] == "Maker"
    assert found.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] == "2026:05:01 12:00:00"
    degrees, minutes, seconds = map(float, gps[ExifTags.GPS.GPSLatitude])
    assert degrees + minutes / 60.0 + seconds / 3600.0 == pytest.approx(33.8568, abs=1e-7)
    assert (gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLongitudeRef]) == ("S", "E")
    assert float(gps[ExifTags.GPS.GPSImgDirection]) == pytest.approx(271.24)
    assert xmp["subject"]["Bag"]["li"] == ["Küche", "Ground & first"]
    assert xmp["hierarchicalSubject"]["Bag"]["li"] == "Ground & first|Küche"
    assert xmp["GPSImgDirection"] == "27124/100"
    assert xmp["GPSLatitude"].endswith("S")


def test_metadata_that_cannot_be_written_again_stay() -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", "Model"
    # A text that is said to be a fraction.
    damaged = exif.tobytes().replace(b"\x01\x0f\0\2\0\0\0\6", b"\x01\x0f\0\5\0\0\0\1")
    copy, sidecar = placed_copy(_picture("JPEG", exif=damaged), PLACE)
    assert (damaged in copy, sidecar) == (True, None)


@pytest.mark.parametrize("kind", ["WEBP", "HEIF"])
def test_other_formats_get_a_file_beside_them(kind: str) -> None:
    content = (FOLDER / "phone.heic").read_bytes() if kind == "HEIF" else _picture(kind)
    copy, sidecar = placed_copy(content, PLACE)
    # Byte by byte, so that the pixels are the same whatever decodes them.
    assert copy == content
    root = fromstring(present(sidecar).decode().partition("?>")[2].rpartition("<?xpacket")[0])
    names = [element.text for element in root.iter() if element.tag.endswith("}li")]
    assert names == ["Küche", "Ground & first", "Ground & first|Küche"]
    stated = {element.tag.rpartition("}")[2]: element.text for element in root.iter()}
    assert (stated["Location"], stated["GPSImgDirection"]) == ("Küche", "27124/100")


@pytest.mark.slow
def test_files_of_one_name_get_files_beside_them_of_two(
    tmp_path: Path, pinned: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "visit", tmp_path / "out"
    folder.mkdir()
    for name in ("kitchen", "study"):
        with Image.open(EXAMPLES / f"{name}.jpg") as picture:
            picture.resize((512, 256)).save(folder / f"{name}.webp")
    (folder / "study.webp").rename(folder / "kitchen.WEBP")
    assert main(["pin", str(pinned[0].parent / "flat.json"), str(folder), "--out", str(out)]) == 0
    beside = "copies with their place in an .xmp file beside them: 2"
    assert beside in capsys.readouterr().err
    assert beside in json.loads((out / "pins.json").read_text())["notes"]
    assert beside in pypdfium2.PdfDocument(out / "report.pdf")[0].get_textpage().get_text_range()
    copies = sorted(path.name for path in (out / "photographs").iterdir())
    assert copies == ["kitchen.WEBP", "kitchen.webp", "kitchen.webp.xmp", "kitchen.xmp"]


def test_keywords_of_the_file_stay() -> None:
    packet = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<rdf:Description xmlns:dc="http://purl.org/dc/elements/1.1/"><dc:subject><rdf:Bag><rdf:li>site</rdf:li>'
        b"</rdf:Bag></dc:subject></rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    copy, _ = placed_copy(_picture("JPEG", xmp=packet), PLACE)
    with Image.open(io.BytesIO(copy)) as picture:
        words = picture.getxmp()["xmpmeta"]["RDF"]["Description"]["subject"]["Bag"]["li"]
    assert words == ["site", "Küche", "Ground & first"]
