"""The command line: localisation, drawing, errors and packaging."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import ExifTags, Image

from lalaloc_core import __version__
from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.cli import main
from lalaloc_core.cli.printing import print_warnings
from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import EXAMPLES, jpeg, sphere, take

ROOT = Path(__file__).parents[2]
PLAN, KITCHEN, BEDROOM = (str(EXAMPLES / name) for name in ("flat.json", "kitchen.jpg", "bedroom.jpg"))
MAIN = "import sys; from lalaloc_core.cli import main; sys.exit(main())"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def run_in(folder: Path, *arguments: str, program: str = MAIN) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(
        command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=300, check=False
    )


def test_real_photographs_are_found(capsys: pytest.CaptureFixture[str]) -> None:
    real = EXAMPLES / "real"
    # Positions from the annotations of the photographs.
    truth = {"cayley_interior": (15.30, 2.71), "hotel_room": (1.58, 1.58), "lythwood_room": (7.97, 3.44)}
    photographs = [str(real / f"{name}.jpg") for name in truth]
    assert main(["localise", str(real / "rooms.json"), *photographs, "--json"]) == 0
    for answer, (x_m, y_m) in zip(json.loads(capsys.readouterr().out), truth.values(), strict=True):
        assert math.hypot(answer["position"]["x_m"] - x_m, answer["position"]["y_m"] - y_m) < 0.5
        assert answer["confidence"] > 0.5


@pytest.mark.slow
def test_localise_works_from_any_folder(tmp_path: Path) -> None:
    done = run_in(tmp_path, "localise", PLAN, KITCHEN, "--heading", "250", "--out", "answer.png", "--json")
    assert done.returncode == 0, done.stderr
    (answer,) = json.loads(done.stdout)
    (truth,) = [pose for pose in json.loads((EXAMPLES / "poses.json").read_text()) if pose["file"] == "kitchen.jpg"]
    assert answer["room"] == "kitchen"
    assert answer["position"]["x_m"] == pytest.approx(truth["x_m"], abs=0.2)
    assert answer["position"]["y_m"] == pytest.approx(truth["y_m"], abs=0.2)
    assert answer["heading_deg"] == pytest.approx(250.0)
    assert answer["confidence"] > 0.9
    assert answer["stage"] == "lpo"
    with Image.open(tmp_path / "answer.png") as picture:
        assert (picture.format, picture.width) == ("PNG", 1600)


@pytest.mark.slow
def test_features_replace_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    phone, features = str(EXAMPLES / "phone.jpg"), str(tmp_path / "phone.features")
    assert main(["encode", phone, "-o", features]) == 0
    assert main(["encode", KITCHEN, BEDROOM, "-o", features]) == 2
    capsys.readouterr()
    assert main(["localise", PLAN, phone, features, "--json", "--out", str(tmp_path / "answer.svg")]) == 0
    by_photograph, by_features = json.loads(capsys.readouterr().out)
    for name in ("x_m", "y_m"):
        assert by_features["position"][name] == pytest.approx(by_photograph["position"][name], abs=0.01)
    assert by_features["room"] == by_photograph["room"]
    assert "data:image/jpeg" not in (tmp_path / "answer-1.svg").read_text()
    assert main(["localise", PLAN, features, "--hfov", "60"]) == 2
    assert "lalaloc encode" in capsys.readouterr().err
    assert main(["localise", PLAN, str(EXAMPLES / "flat.json")]) == 2


def test_features_reveal_the_shape_of_a_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    features = tmp_path / "kitchen.features"
    assert main(["encode", KITCHEN, "-o", str(features)]) == 0
    capsys.readouterr()
    assert main(["features", str(features), "--out", str(tmp_path / "room.png")]) == 0
    room = json.loads(capsys.readouterr().out)
    assert max(room["room_types"], key=room["room_types"].get) == "kitchen"
    assert room["ceiling_height_m"] == pytest.approx(2.6, abs=0.4)
    assert {opening["kind"] for opening in room["openings"]} >= {"door", "window"}
    assert len(room["walls"]) == 128
    with Image.open(tmp_path / "room.png") as picture:
        assert picture.format == "PNG"


@pytest.mark.slow
def test_track_follows_spheres_and_phone_photographs(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    shutil.copy(KITCHEN, walk / "0.00.jpg")
    phone = take(sphere("kitchen"), Perspective.of_hfov(640, 480, math.radians(81.2)))
    lens = {ExifTags.Base.FocalLengthIn35mmFilm: 21, ExifTags.Base.ExifImageWidth: 640}
    (walk / "1.50.jpg").write_bytes(jpeg(phone, lens | {ExifTags.Base.ExifImageHeight: 480}))
    odometry = tmp_path / "odometry.csv"
    odometry.write_text("time_s,x_m,y_m,yaw_deg\n0,2,1,30\n2,2,1,30\n")
    options = ["--odometry", str(odometry), "--pitch", "0", "--roll", "0", "--json"]
    done = run_in(tmp_path, "track", PLAN, str(walk), *options, "--trajectory", "path.tum")
    assert done.returncode == 0, done.stderr
    first, second = json.loads(done.stdout)
    assert [first["view"]["projection"], second["view"]["projection"]] == ["equirectangular", "perspective"]
    assert second["view"]["roll"]["source"] == "given"
    for answer in (first, second):
        assert (answer["room"], answer["motion_contradicted"]) == ("kitchen", [])
    assert len((tmp_path / "path.tum").read_text().splitlines()) == 2


def test_several_photographs_give_rows_and_pictures(
    tiny_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answer.svg"
    command = ["localise", PLAN, KITCHEN, BEDROOM, "--bundle", str(tiny_bundle), "--out", str(out), "--picture", "plan"]
    assert main(command) == 0
    head, rule, *rows = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["photograph", "room"]
    assert set(rule) == {"-", " "}
    assert [row.split()[0] for row in rows] == [KITCHEN, BEDROOM]
    drawn = [(tmp_path / f"answer-{number}.svg").read_text() for number in (0, 1)]
    assert "kitchen.jpg" in drawn[0]
    assert "bedroom.jpg" in drawn[1]
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("answer-1.svg", KITCHEN, BEDROOM, "--out", "answer.svg"),
        (PLAN, "--turn", "turn", "--csv", "turn/1.jpg"),
        (PLAN, "--turn", "turn", "--csv", "link"),
    ],
)
def test_no_file_that_is_read_is_written(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "answer-1.svg").touch()
    (tmp_path / "turn").mkdir()
    (tmp_path / "turn" / "1.jpg").touch()
    (tmp_path / "link").symlink_to(PLAN)
    with contextlib.chdir(tmp_path):
        assert main(["localise", *arguments]) == 2
    assert "is read and never changed" in capsys.readouterr().err


def test_many_photographs_give_a_table_places_on_earth_and_a_map(
    tiny_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, formula = tmp_path / "plan.json", tmp_path / "=1+1\udcff\x07.jpg"
    plan.write_text(
        json.dumps(
            json.loads(Path(PLAN).read_text()) | {"north_deg": 0.0, "anchor": {"longitude": 13.4, "latitude": 52.5}}
        )
    )
    shutil.copy(BEDROOM, formula)
    files = [str(tmp_path / name) for name in ("out.csv", "out.geojson", "map.svg")]
    options = [
        text for option, file in zip(("--csv", "--geojson", "--map"), files, strict=True) for text in (option, file)
    ]
    photographs = [KITCHEN, str(plan), os.path.relpath(formula, tmp_path)]
    command = ["localise", str(plan), *photographs, "--bundle", str(tiny_bundle), "--json", *options]
    with contextlib.chdir(tmp_path):
        assert main(command) == 2
    out, errors = capsys.readouterr()
    kitchen, failed, bedroom = json.loads(out)
    assert list(failed) == ["photograph", "error"]
    assert failed["error"] in errors
    assert "1 of 3 photographs were not localised" in errors
    with Path(files[0]).open(encoding="utf-8", newline="") as table:
        rows = list(csv.DictReader(table))
    assert [row["photograph"] for row in rows] == [KITCHEN, str(plan), "'=1+1?\x07.jpg"]
    assert [bool(row["error"]) for row in rows] == [False, True, False]
    assert float(rows[0]["x_m"]) == pytest.approx(kitchen["position"]["x_m"], abs=1e-3)
    assert (rows[1]["room"], rows[2]["room"]) == ("", bedroom["room"])
    features = json.loads(Path(files[1]).read_text())["features"]
    assert [feature["properties"]["photograph"] for feature in features] == [KITCHEN, formula.name]
    for feature in features:
        assert feature["geometry"]["coordinates"] == pytest.approx([13.4, 52.5], abs=1e-3)
    drawn = Path(files[2]).read_text()
    assert (drawn.count('class="camera"'), "kitchen" in drawn, "=1+1\ufffd\ufffd" in drawn) == (2, True, True)


def test_warnings_are_told_once_by_cause(capsys: pytest.CaptureFixture[str]) -> None:
    print_warnings([("a.jpg", "60° ± 8°"), ("a.jpg", "state hfov_deg"), ("b.jpg", "61.5° ± 9°"), ("b.jpg", "62° ± 9°")])
    assert capsys.readouterr().err == "warning: a.jpg and 1 more: 60° ± 8°\nwarning: a.jpg: state --hfov\n"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([PLAN, KITCHEN, "--geojson", "out.geojson"], "give it an anchor"),
        ([PLAN, KITCHEN, "--map", "map.gif"], "it must end in .png or .svg (--map)"),
        ([PLAN, KITCHEN, "--csv", "/gone/out.csv"], "cannot be written"),
        ([PLAN, KITCHEN, "--map", KITCHEN], "kitchen.jpg' is read and never changed"),
        ([PLAN, KITCHEN, "--out", PLAN], "flat.json' is read and never changed"),
        (["gone.json", KITCHEN], "'gone.json' cannot be read"),
        ([PLAN, "gone.jpg"], "'gone.jpg' cannot be read"),
        ([PLAN, PLAN], "flat.json': the photograph is"),
        ([PLAN, KITCHEN, "--out", "answer.gif"], "'answer.gif'; it must end in .png or .svg"),
        ([PLAN, KITCHEN, "--out", "/gone/answer.svg", "--picture", "plan"], "cannot be written"),
        ([PLAN, KITCHEN, "--camera-height", "3"], "camera_height_m is 3; it must be at least 0.1 and below"),
        ([PLAN, KITCHEN, "--heading-tolerance", "3"], "--heading, which is missing"),
    ],
)
def test_errors_are_one_line(
    tiny_bundle: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    assert main(["localise", *arguments, "--bundle", str(tiny_bundle)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert complaint in line


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        ("lab evaluate --bundle {bundle} --out {out} --data nowhere", 2, "nowhere"),
        ("lab evaluate --bundle {bundle} --out {out} --lighting warm", 2, "no photographs 'full/warm'"),
        ("lab evaluate --bundle {bundle} --out {out} --data {own_data} --split train", 2, "split 'train'"),
        ("lab evaluate --bundle {out} --homes 1", 1, "error: no model bundle at"),
        ("lab export --run {out} --out {out} --version 1", 1, "error: no checkpoint at"),
        ("lab score {out}", 1, "error: no evaluation run at"),
        ("lab reproduce --table roof", 2, "unknown table 'roof'; --table is one of localisation"),
        ("lab reproduce", 2, "no table is chosen"),
        ("lab reproduce --table similarity", 2, "--data is missing"),
        ("lab synth --out {out} --scenes 1 --height 33", 2, "height is 33; it must be an even number"),
        ("lab synth --out {out} --scenes 1 --height 8", 2, "height is 8"),
        ("lab synth --out {out} --scenes 1 --seed -1", 2, "seed is -1"),
        ("lab synth --out {out} --scenes 1 --workers 0", 2, "workers is 0; the minimum is 1"),
        ("lab synth --out {out} --scenes 1 --textures nowhere", 2, "no <category>/<material>/*.jpg below 'nowhere'"),
        ("lab train layout --out {out} --skip-bad", 2, "--skip-bad"),
        ("lab train layout --out {out} --data x --textures y", 2, "--textures"),
        ("lab train layout --preset tiny-trunk --out {out} --photographs {out}", 2, "--photographs"),
        ("lab train layout --preset tiny-trunk --out {out} --teacher {out}", 2, "--teacher"),
        ("lab train layout --preset tiny-trunk --out {out} --layout-from {out}", 2, "--layout-from"),
        ("lab train image --out {out} --data somewhere --render device", 2, "--render is for generated homes"),
        ("lab train roof --out {out}", 2, "stage is 'roof'"),
        ("lab train layout out={out} depth=3", 2, "no key 'depth'; it has stage, preset, out"),
        ("lab train layout", 2, "lacks the key 'out'"),
        ("lab train {out}/train.toml", 2, "train.toml' cannot be read"),
        ("lab evaluate --kind song", 2, "kind is 'song'"),
        ("lab evaluate --limit 0", 2, "limit is 0; it must be at least 1"),
        ("lab evaluate --grid-step -1", 2, "grid_step is -1; it must be positive"),
        ("lab evaluate --workers -1", 2, "workers is -1; it must be at least 0"),
        ("lab reproduce --limit 0", 2, "limit is 0"),
        ("bench --only roof", 2, "only[0] is 'roof'"),
        ("train layout --out {out}", 2, "`lalaloc train` is now `lalaloc lab train`"),
    ],
)
def test_invalid_request_is_refused_before_writing(
    command: str, code: int, message: str, tiny_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = command.format(bundle=tiny_bundle, out=out, own_data=EXAMPLES / "own_data").split()
    assert main(words) == code
    assert message in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    "command",
    [
        "",
        "fly",
        "localise plan.json photo.jpg --heading 400",
        "localise plan.json photo.jpg --camera-height -1",
        "localise plan.json photo.jpg --heading-tolerance 50",
    ],
)
def test_invalid_argument_is_refused(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    assert ended.value.code == 2
    options = [f"argument {word}" for word in command.split() if word.startswith("--")]
    assert all(option in capsys.readouterr().err for option in options)


def test_configuration_is_a_file_with_changes(tmp_path: Path) -> None:
    from lalaloc_core.cli.lab import configured
    from lalaloc_core.cli.training import COMMANDS

    file = tmp_path / "train.toml"
    file.write_text(
        'stage = "image"\nout = "runs/x"\nskip-bad = true\nset = {"image.batch" = 4}\nphotographs = ["a"]\n'
    )
    words = [str(file), "preset=trunk", "set=image.supersample=[2,1]", "set=image.optics=.5", "photographs=b"]
    train = configured(COMMANDS["train"], words, {"minutes": [".75"], "steps": ["+9"], "from_": ["runs/y"]})
    assert (train.stage, train.preset, train.out, train.skip_bad) == ("image", "trunk", Path("runs/x"), True)
    assert train.set_ == {"image.batch": 4, "image.supersample": [2, 1], "image.optics": 0.5}
    assert (train.photographs, train.minutes, train.steps) == ((Path("a"), Path("b")), 0.75, 9)
    assert train.from_ == Path("runs/y")


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_plan_draw_writes_a_picture(suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"plan{suffix}"
    assert main(["plan", "draw", PLAN, "--out", str(out)]) == 0
    if suffix == ".svg":
        assert "living room" in out.read_text()
    else:
        with Image.open(io.BytesIO(out.read_bytes())) as picture:
            assert max(picture.size) == 1000
            assert picture.convert("RGBA").getchannel("A").getextrema() == (255, 255)


def test_plan_check_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "check", PLAN, "--json"]) == 0
    (plan,) = json.loads(capsys.readouterr().out)
    assert (plan["rooms"], plan["warnings"]) == (7, [])


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"lalaloc {__version__}\n"


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.setattr(sys, "argv", sys.argv)
    assert main(["mcp"]) == 1
    assert "run .venv/bin/pip install -c constraints.txt -e '.[mcp]'" in capsys.readouterr().err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_is_valid(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "--camera-height" in script
    if (program := shutil.which(shell)) is not None:
        (tmp_path / "script").write_text(script)
        subprocess.run([program, "-n", str(tmp_path / "script")], check=True)


def test_closed_pipe_is_not_an_error(tmp_path: Path) -> None:
    command = [sys.executable, "-c", MAIN, "completion", "bash"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        # Before the first line.
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60.0) == 0


def loaded_packages(*arguments: str) -> set[str]:
    program = (
        "import sys; from lalaloc_core.cli import main\n"
        "try:\n    main()\nfinally:\n    print(*{name.split('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    done = run_in(ROOT, *arguments, program=program)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.split())


def test_help_loads_no_other_package() -> None:
    found = loaded_packages("--help")
    assert "lalaloc_core" in found
    heavy = {"numpy", "scipy", "torch", "onnxruntime", "cv2", "PIL", "pydantic", "jaxtyping", "shapely", "tqdm"}
    assert not found & heavy


def test_localise_leaves_torch_unloaded() -> None:
    found = loaded_packages("localise", PLAN, KITCHEN, "--json")
    assert "onnxruntime" in found
    assert "torch" not in found


def test_default_bundle_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert default_bundle() == Path("models/default")
    monkeypatch.chdir(tmp_path)
    assert default_bundle() == ROOT / "models" / "default"
    assert Bundle.open(default_bundle()).manifest.name == "default"
