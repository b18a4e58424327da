"""`lalaloc localise`: localise photographs in a plan, without a service."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.answer_files import FILES, check_file_options, write_files
from lalaloc_core.cli.cameras import add_camera_options, stated_camera
from lalaloc_core.cli.options import BUNDLE, CAMERA_HEIGHT, PLAN, TURN, add_options, check_sources, heading, tolerance
from lalaloc_core.cli.plan_files import add_plan_options, check_picture_name, read_plan, write_picture
from lalaloc_core.cli.printing import JSON_DECIMALS, pose_cells, print_json, print_table, print_warnings, with_options
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError
from lalaloc_core.shown_text import probability_text

if TYPE_CHECKING:
    from lalaloc_core.api import LaLaLoc
    from lalaloc_core.draw.answer import DrawnAnswer
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.answers.documents import Answer
    from lalaloc_core.photograph import StatedCamera


_OPTIONS = f"""
{PLAN}
photographs PHOTO: full spheres, ordinary, fisheye or panorama-mode photographs (docs/how-to/take-photographs.md), or
    their features from `lalaloc encode`
{TURN}
--heading DEG: azimuth of the photographs' centres, clockwise from the plan's +y (default: the photographs' compass if
    the plan has north_deg, otherwise estimated)
--heading-tolerance DEG: maximum error of --heading, at most 45 degrees (default: 0)
{CAMERA_HEIGHT}
--out FILE: picture of the answer to write, .png or .svg; with several photographs their number is appended
--picture: content of --out: the plan with the posterior, the photograph with the predicted layout, or both
    (default: %(default)s); of features only the plan
{FILES}
--json: print JSON: a list with one answer per photograph
{BUNDLE}
"""


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    localise = commands.add_parser("localise", help="localise photographs in a plan, without a service")
    add_options(
        localise,
        _OPTIONS,
        photographs={"nargs": "*"},
        heading={"type": heading},
        heading_tolerance={"type": tolerance},
        picture={"action": "store", "choices": ("both", "plan", "photograph"), "default": "both"},
    )
    add_camera_options(localise)
    add_plan_options(localise)
    localise.set_defaults(run=_localise)


def _localise(arguments: argparse.Namespace) -> None:
    from lalaloc_core.api import LaLaLoc
    from lalaloc_core.draw.answer import drawn_answer
    from lalaloc_core.localise.query.query import check_height_m

    if arguments.heading_tolerance is not None and arguments.heading is None:
        raise InvalidInputError("--heading-tolerance needs --heading, which is missing")
    check_sources(arguments)
    if arguments.turn is not None and arguments.heading is not None:
        raise InvalidInputError("--heading does not go with --turn, whose headings are searched; leave it out")
    if arguments.out is not None:
        check_picture_name(arguments.out)
    plan = read_plan(arguments.plan, arguments).plan()
    if arguments.camera_height is not None:
        check_height_m(plan, arguments.camera_height)
    check_file_options(arguments, plan)
    stated, several = stated_camera(arguments), len(arguments.photographs) > 1
    documents, rows, places, warnings = [], [], [], []
    model = LaLaLoc(arguments.bundle)
    find = _answers if arguments.turn is None else _turn_answers
    for number, (path, answer, document) in enumerate(find(arguments, model, plan, stated)):
        documents.append(document)
        if answer is None:
            print(f"error: {with_options(document['error'])}", file=sys.stderr)
            continue
        warnings += [(name, text) for text in document["warnings"] for name in _names(path, document, text)]
        drawn = drawn_answer(answer)
        rows.append(_row(document, drawn))
        places.append((path.stem, drawn.camera))
        if arguments.out is not None:
            out = arguments.out.with_stem(f"{arguments.out.stem}-{number}") if several else arguments.out
            _draw(drawn, path, out, arguments, stated, path.name if several else None)
    print_warnings(warnings)
    write_files(arguments, plan, documents, places)
    if arguments.json:
        print_json(documents, JSON_DECIMALS)
    else:
        print_table(_HEAD, rows)
    if len(rows) < len(documents):
        failed = len(documents) - len(rows)
        raise InvalidPhotographError(
            f"{failed} of {len(documents)} photographs were not localised; see the errors above"
        )


def _answers(
    arguments: argparse.Namespace, model: LaLaLoc, plan: FloorPlan, stated: StatedCamera
) -> Iterator[tuple[Path, Answer | None, dict[str, Any]]]:
    """Yield photographs in order with their answers, None where it failed, and documents, with a progress bar."""
    from tqdm import tqdm

    paths = tqdm(arguments.photographs, desc="localise", unit="photograph", disable=None, leave=False)
    for path in paths:
        try:
            answer = model.localise(
                plan,
                path,
                heading_deg=arguments.heading,
                heading_tolerance_deg=arguments.heading_tolerance or 0.0,
                camera_height_m=arguments.camera_height,
                camera=stated,
            )
        except InvalidPhotographError as error:
            if len(arguments.photographs) == 1:
                raise
            yield path, None, {"photograph": str(path), "error": str(error)}
        else:
            yield path, answer, {"photograph": str(path), **answer.document(), "warnings": _remarks(answer)}


def _turn_answers(
    arguments: argparse.Namespace, model: LaLaLoc, plan: FloorPlan, stated: StatedCamera
) -> Iterator[tuple[Path, Answer | None, dict[str, Any]]]:
    """Yield the answer for a turn, with the angles of its photographs."""
    from lalaloc_core.photograph.picture_folders import turn_files

    path = arguments.turn
    files, left_out = turn_files(path) if path.is_dir() else ([], [])
    source = files if len(files) > 1 else path
    answer = model.localise_turn(plan, source, camera_height_m=arguments.camera_height, camera=stated)
    names = [f"frame {number + 1}" if answer.film else files[number].name for number in range(len(answer.poses))]
    remarks = [re.sub(r"photo\[(\d+)\]", lambda found: names[int(found[1])], text) for text in _remarks(answer)]
    document = {"photograph": str(path), **answer.document(), "warnings": [*left_out, *remarks]}
    if answer.film is None:
        poses = zip(files, document["poses"], strict=True)
        document["poses"] = [{"photograph": file.name, **pose} for file, pose in poses]
    yield path, answer, document


def _names(path: Path, document: dict[str, Any], warning: str) -> list[str]:
    """Return the photographs of a turn that a warning is about; for others, the photograph or the turn itself."""
    poses = [pose for pose in document.get("poses", ()) if warning in pose["view"]["warnings"]]
    return [str(path / pose["photograph"]) for pose in poses if "photograph" in pose] or [str(path)]


def _remarks(answer: Answer) -> list[str]:
    """Return the warnings of an answer, those of several photographs once, and what to do about its confidence."""
    film, step = getattr(answer, "film", None), answer.view.next_step
    warnings = [re.sub(r"^photo\[\d+\]: ", "", text) for text in answer.warnings]
    advice = filter(None, (answer.view.advice, None if step is None else step.text))
    return list(dict.fromkeys([*([] if film is None else film.warnings), *warnings, *advice]))


_HEAD = ("photograph", "room", "x m", "y m", "heading °", "95 % within", "camera m", "confidence")


def _row(document: dict[str, Any], drawn: DrawnAnswer) -> tuple[str, ...]:
    from lalaloc_core.draw.answer import ellipse_m

    covariance = drawn.camera.covariance_m2
    return (
        document["photograph"],
        *pose_cells(document),
        "-" if covariance is None else f"{100 * ellipse_m(covariance)[0]:.0f} cm",
        f"{drawn.camera_height_m:.2f}",
        "-" if drawn.confidence is None else probability_text(drawn.confidence),
    )


def _draw(
    drawn: DrawnAnswer, path: Path, out: Path, arguments: argparse.Namespace, stated: StatedCamera, title: str | None
) -> None:
    """Draw an answer, with its photograph read in the size of the picture."""
    from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE, draw_answer
    from lalaloc_core.localise.encode.features import is_features
    from lalaloc_core.photograph.photograph import open_photograph, open_picture

    # Turns and features have no photograph to show.
    content = b"" if arguments.turn is not None else path.read_bytes()
    picture, pixels = "plan" if not content or is_features(content) else arguments.picture, None
    if picture != "plan" and drawn.photograph is not None:
        pixels = open_picture(content, max_size=PHOTOGRAPH_SIZE)
    elif picture != "plan":
        width, height = PHOTOGRAPH_SIZE
        pixels = open_photograph(content, sphere_size=(height, width), stated=stated).sphere
    write_picture(draw_answer(drawn, pixels, picture, title=title), out)
