"""`lalaloc localise`: localise photographs in a plan, without a service."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.answer_files import add_file_options, check_file_options, write_files
from lalaloc_core.cli.cameras import add_camera_options, content_of, named, stated_camera, view_document
from lalaloc_core.cli.options import add_options, heading, tolerance
from lalaloc_core.cli.plan_files import add_plan_options, check_picture_name, read_plan, write_picture
from lalaloc_core.cli.printing import JSON_DECIMALS, pose_cells, pose_document, print_json, print_table
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError

if TYPE_CHECKING:
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.draw.answer import DrawnAnswer
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.local_model import LocalModel
    from lalaloc_core.localise.match import PoseGrid
    from lalaloc_core.localise.search.pipeline import Localisation
    from lalaloc_core.photograph import Photograph, StatedCamera


@dataclass(frozen=True, eq=False)
class _Found:
    """The answer for one photograph, or the error if it has none."""

    photograph: Path
    content: bytes
    drawn: DrawnAnswer | None
    document: dict[str, Any]


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    localise = commands.add_parser("localise", help="localise photographs in a plan, without a service")
    localise.add_argument(
        "plan", type=Path, metavar="PLAN", help="a floor plan, in any format of docs/how-to/import-a-plan.md"
    )
    localise.add_argument(
        "photographs",
        type=Path,
        nargs="*",
        metavar="PHOTO",
        help="full spheres, ordinary, fisheye or panorama-mode photographs (docs/how-to/take-photographs.md), or "
        "their features from `lalaloc encode`",
    )
    localise.add_argument(
        "--turn",
        type=Path,
        metavar="FILM",
        help="film of one slow turn on the spot, or a folder of photographs of one, instead of PHOTO",
    )
    localise.add_argument(
        "--heading",
        type=heading,
        metavar="DEG",
        help="azimuth of the photographs' centres, clockwise from the plan's +y (default: the photographs' "
        "compass if the plan has north_deg, otherwise estimated)",
    )
    localise.add_argument(
        "--heading-tolerance",
        type=tolerance,
        metavar="DEG",
        help="maximum error of --heading, at most 45 degrees (default: 0)",
    )
    add_options(localise, "--camera-height")
    add_camera_options(localise)
    localise.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="picture of the answer to write, .png or .svg; with several photographs their number is appended",
    )
    localise.add_argument(
        "--picture",
        choices=("both", "plan", "photograph"),
        default="both",
        help="content of --out: the plan with the posterior, the photograph with the predicted layout, or both "
        "(default: %(default)s); of features only the plan",
    )
    add_file_options(localise)
    localise.add_argument("--json", action="store_true", help="print JSON: a list with one answer per photograph")
    add_options(localise, "--bundle")
    add_plan_options(localise)
    localise.set_defaults(run=_localise)


def _localise(arguments: argparse.Namespace) -> None:
    from lalaloc_core.draw.answer import draw_answer
    from lalaloc_core.localise.encode.features import is_features

    if arguments.heading_tolerance is not None and arguments.heading is None:
        raise InvalidInputError("--heading-tolerance needs --heading, which is missing")
    if bool(arguments.photographs) == (arguments.turn is not None):
        raise InvalidInputError("photographs and --turn exclude each other; give one or more photographs, or --turn")
    if arguments.out is not None:
        check_picture_name(arguments.out)
    plan = read_plan(arguments.plan, arguments).plan()
    _check_height(arguments.camera_height, plan)
    check_file_options(arguments, plan)
    stated, several = stated_camera(arguments), len(arguments.photographs) > 1
    documents, rows, places = [], [], []
    answers = _answers(arguments, plan, stated) if arguments.turn is None else [_turn_answer(arguments, plan, stated)]
    for number, answer in enumerate(answers):
        documents.append(answer.document)
        if answer.drawn is None:
            print(f"error: {answer.document['error']}", file=sys.stderr)
            continue
        for warning in answer.document["warnings"]:
            print(f"warning: {answer.photograph}: {warning}", file=sys.stderr)
        rows.append(_row(answer.document, answer.drawn))
        places.append((answer.photograph.stem, answer.drawn.camera))
        if arguments.out is not None:
            out = arguments.out.with_stem(f"{arguments.out.stem}-{number}") if several else arguments.out
            # Features have no photograph to show.
            picture = "plan" if not answer.content or is_features(answer.content) else arguments.picture
            shown = None if picture == "plan" else _pixels(answer.drawn, answer.content, stated)
            title = answer.photograph.name if several else None
            write_picture(draw_answer(answer.drawn, shown, picture, title=title), out)
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


def _answers(arguments: argparse.Namespace, plan: FloorPlan, stated: StatedCamera) -> Iterator[_Found]:
    """Yield the answers in the order of the photographs, with a progress bar on a terminal."""
    from tqdm import tqdm

    from lalaloc_core.bundle import Bundle
    from lalaloc_core.draw.answer import drawn_answer
    from lalaloc_core.localise.local_model import LocalModel
    from lalaloc_core.localise.query import known_heading, stated_height

    bundle = Bundle.open(arguments.bundle)
    model = LocalModel(bundle)
    height = stated_height(plan, arguments.camera_height)
    # Models that compare only latents need a pose grid per camera height.
    grid = model.grid(plan, plan.camera_height_m if model.encoder.predicts_profile else height.height_m)
    paths = tqdm(arguments.photographs, desc="localise", unit="photograph", disable=None, leave=False)
    for path in paths:
        content = b""
        try:
            content = content_of(path)
            with named(path):
                view = _opened(content, model, bundle, stated)
                model.encoder.check(view)
        except InvalidPhotographError as error:
            if len(arguments.photographs) == 1:
                raise
            yield _Found(path, content, None, {"photograph": str(path), "error": str(error)})
            continue
        tolerance_deg = arguments.heading_tolerance or 0.0
        known = known_heading(plan.north, arguments.heading, tolerance_deg, view.compass_heading)
        query = model.encoder.query(view, known.heading, height, heading_tolerance=known.tolerance)
        found = model.localise(plan, grid, query)
        confidence_model = bundle.manifest.confidence_for(view=query.is_view)
        drawn = drawn_answer(plan, grid, found, confidence_model, _SOURCES[known.source], photograph=view)
        source = "searched" if found.heading_contradicted else known.source
        details = {"stage": found.stage, "heading_source": source, **_details(plan, grid, bundle, view, found)}
        yield _Found(path, content, drawn, _document(path, drawn) | details)


def _opened(content: bytes, model: LocalModel, bundle: Bundle, stated: StatedCamera) -> Photograph:
    """Return a photograph, or the one whose features a file has."""
    from lalaloc_core.localise.encode.features import is_features, read_features
    from lalaloc_core.photograph import StatedCamera

    if not is_features(content):
        return model.open(content, stated)
    if stated != StatedCamera():
        raise InvalidPhotographError("the camera is stated to `lalaloc encode`; leave its options out")
    return read_features(content, bundle)


def _details(plan: FloorPlan, grid: PoseGrid, bundle: Bundle, view: Photograph, found: Localisation) -> dict[str, Any]:
    """Return the fields of an answer about its photograph, with warnings, advice and the next step."""
    from lalaloc_core.localise.belief import advice_for, information_bits, reason_for
    from lalaloc_core.localise.localisability.reports import step_after

    confidence = found.confidence(bundle.manifest.confidence_for(view=found.query.is_view))
    sure = found.posterior.position if confidence is None else confidence.position
    advice = advice_for([view.azimuths], sure)
    step = step_after(
        plan, bundle.manifest, found, confidence, arcs=[view.azimuths], field=view.hfov.value, step_m=grid.step_m
    )
    warnings = ["the photograph contradicts the heading, which was estimated instead"]
    warnings = [*view.warnings, *(warnings if found.heading_contradicted else [])]
    if confidence is not None:
        objects, is_warned = found.query.objects, bool(warnings)
        reason = reason_for(confidence.position, confidence.elsewhere, objects, is_warned=is_warned)
        warnings += [] if reason is None else [reason]
    return {
        "heading_confidence": None if confidence is None else confidence.heading,
        "probability_elsewhere": None if confidence is None else confidence.elsewhere,
        "warnings": [*warnings, *([] if advice is None else [advice]), *([] if step is None else [step["text"]])],
        "view": view_document(view)
        | {"information_bits": information_bits(plan, grid.poses, found.posterior.pose), "next_step": step},
        "model": _model_document(bundle),
    }


def _model_document(bundle: Bundle) -> dict[str, str]:
    return {"name": bundle.manifest.name, "version": bundle.manifest.version, "sha256": bundle.sha256}


def _turn_answer(arguments: argparse.Namespace, plan: FloorPlan, stated: StatedCamera) -> _Found:
    """Return the answer for a turn, with the angles of its photographs."""
    from tqdm import tqdm

    from lalaloc_core.bundle import Bundle
    from lalaloc_core.cli.turning import read_turn, turn_document
    from lalaloc_core.draw.answer import drawn_answer
    from lalaloc_core.localise.local_model import LocalModel
    from lalaloc_core.localise.query import stated_height

    if arguments.heading is not None:
        raise InvalidInputError("--heading does not go with --turn, whose headings are searched; leave it out")
    path, bundle = arguments.turn, Bundle.open(arguments.bundle)
    model = LocalModel(bundle)
    height = stated_height(plan, arguments.camera_height)
    with tqdm(total=2, desc="read the turn", disable=None, leave=False) as progress:
        turn = read_turn(path, bundle.manifest, stated)
        progress.update()
        progress.set_description("localise")
        grid = model.grid(plan, plan.camera_height_m if model.encoder.predicts_profile else height.height_m)
        found = model.localise_turn(plan, grid, turn.photographs, turn.linked, height)
    first, confidence = found.pictures[0], found.confidence(bundle.manifest)
    confidence_model = bundle.manifest.confidence_for(view=first.query.is_view, turn=first.query.is_turn)
    drawn = drawn_answer(plan, grid, first, confidence_model, _SOURCES["searched"], photograph=turn.photographs[0])
    details = {
        "stage": found.stage,
        "heading_source": "searched",
        "confidence": confidence,
        "warnings": turn.warnings,
        "model": _model_document(bundle),
    }
    return _Found(path, b"", drawn, _document(path, drawn) | details | turn_document(turn, found))


def _document(path: Path, drawn: DrawnAnswer) -> dict[str, Any]:
    """Return an answer as JSON, with the field names of the API."""
    camera, covariance = drawn.camera, None
    if camera.covariance_m2 is not None:
        xx, xy, yy = camera.covariance_m2
        covariance = [[xx, xy], [xy, yy]]
    rivals = [
        {
            "position": {"x_m": rival.x_m, "y_m": rival.y_m},
            "heading_deg": rival.heading_deg,
            "room": rival.room,
            "probability": rival.probability,
        }
        for rival in drawn.rivals
    ]
    pose = pose_document(drawn.plan, drawn.room_index, camera.x_m, camera.y_m, camera.heading_deg)
    best = {name: pose[name] for name in ("position", "heading_deg", "room")}
    return {
        "photograph": str(path),
        **pose,
        "confidence": drawn.confidence,
        "covariance_m2": covariance,
        "camera_height_m": drawn.camera_height_m,
        "candidates": [{**best, "probability": drawn.confidence}, *rivals],
    }


_HEAD = ("photograph", "room", "x m", "y m", "heading °", "95 % within", "camera m", "confidence")
_SOURCES = {"given": "given", "photograph": "from the compass", "searched": "estimated"}


def _row(document: dict[str, Any], drawn: DrawnAnswer) -> tuple[str, ...]:
    from lalaloc_core.draw.answer import ellipse_m

    covariance = drawn.camera.covariance_m2
    return (
        document["photograph"],
        *pose_cells(document),
        "-" if covariance is None else f"{100 * ellipse_m(covariance)[0]:.0f} cm",
        f"{drawn.camera_height_m:.2f}",
        "-" if drawn.confidence is None else f"{100 * drawn.confidence:.1f} %",
    )


def _pixels(drawn: DrawnAnswer, content: bytes, stated: StatedCamera) -> Any:
    """Read the photograph in the size of the picture."""
    from lalaloc_core.draw.answer import PHOTOGRAPH_SIZE
    from lalaloc_core.photograph.photograph import open_photograph, open_picture

    if drawn.photograph is not None:
        return open_picture(content, max_size=PHOTOGRAPH_SIZE)
    width, height = PHOTOGRAPH_SIZE
    view = open_photograph(content, sphere_size=(height, width), stated=stated)
    assert view.sphere is not None
    return view.sphere


def _check_height(height_m: float | None, plan: FloorPlan) -> None:
    from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M

    lowest_m = float(plan.ceiling_heights_m.min())
    if height_m is not None and not MIN_CAMERA_HEIGHT_M <= height_m < lowest_m:
        raise InvalidInputError(
            f"--camera-height is {height_m:g} m; it must be at least {MIN_CAMERA_HEIGHT_M:g} m and below the plan's "
            f"lowest ceiling ({lowest_m:g} m)"
        )
