"""`lalaloc evaluate`, `score`, `report`, `worst` and `calibrate`."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from lalaloc_core.cli.options import add_options, count, positive
from lalaloc_core.cli.printing import print_json, print_table
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.dataset_names import DATASET_FORMATS, SPLITS

# Decimals of printed scores; a run's folder has all.
_DECIMALS = 4
# Columns of the printed table.
_SHARES = ("within_10cm", "within_50cm", "within_1m", "within_1m_30deg", "correct_room", "heading_within_2deg")


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    _add_evaluate(commands)
    _add_score(commands)
    _add_report(commands)
    _add_worst(commands)
    _add_calibrate(commands)


def _add_evaluate(commands: Any) -> None:
    evaluate = commands.add_parser(
        "evaluate", help="localise the queries of a data set or of generated homes, and score the answers"
    )
    add_options(evaluate, "--bundle")
    evaluate.add_argument(
        "--method",
        default="lalaloc",
        choices=("lalaloc", "oracle", "icp", "explicit", "decode"),
        help="localisation method (default: %(default)s)",
    )
    evaluate.add_argument(
        "--kind", choices=("layout", "panorama"), default="panorama", help="kind of query (default: %(default)s)"
    )
    _data_arguments(evaluate)
    evaluate.add_argument("--split", choices=SPLITS, default="test", help="split (default: %(default)s)")
    evaluate.add_argument(
        "--furniture", choices=("empty", "simple", "full"), help="furniture level (default: by data set)"
    )
    evaluate.add_argument("--lighting", choices=("cold", "raw", "warm"), help="lighting (default: by data set)")
    evaluate.add_argument(
        "--heading", choices=("known", "unknown"), help="heading of queries (default: known; that of albums is unknown)"
    )
    evaluate.add_argument(
        "--grid-step",
        type=positive,
        default=0.5,
        metavar="M",
        help="step of the pose grid, metres (default: %(default)s)",
    )
    evaluate.add_argument(
        "--view", type=positive, metavar="DEG", help="cut views of this field of view (default: whole spheres)"
    )
    evaluate.add_argument(
        "--heading-error", type=positive, metavar="DEG", help="largest error of the known heading of views (default: 0)"
    )
    evaluate.add_argument(
        "--albums",
        action="store_true",
        help="solve all photographs of a scene together, as `lalaloc pin`; files can be of any projection",
    )
    evaluate.add_argument("--refine", choices=("none", "vdr", "lpo"), help="last stage of refinement (default: lpo)")
    evaluate.add_argument("--limit", type=count, metavar="N", help="maximum number of queries (default: all)")
    add_options(evaluate, "--skip-bad", "--workers")
    evaluate.add_argument("--out", type=Path, metavar="RUN", help="folder of the run; an existing run is continued")
    evaluate.add_argument("--json", action="store_true", help="print all figures as JSON")
    evaluate.set_defaults(run=_evaluate)


def _add_score(commands: Any) -> None:
    score = commands.add_parser("score", help="score the stored predictions of runs again, without model or data")
    score.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    score.add_argument("--json", action="store_true", help="print all figures as JSON")
    score.set_defaults(run=_score)


def _add_report(commands: Any) -> None:
    report = commands.add_parser("report", help="write a self-contained HTML report about runs")
    report.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    report.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="FILE", help="page to write (default: %(default)s)"
    )
    report.add_argument("--pictures", type=Path, metavar="DIR", help="folder to write the page's pictures to as well")
    report.set_defaults(run=_report)


def _add_worst(commands: Any) -> None:
    worst = commands.add_parser("worst", help="draw the worst queries of a run and count their properties")
    worst.add_argument("folder", type=Path, metavar="RUN", help="folder of the run")
    worst.add_argument("--count", type=count, default=100, metavar="N", help="number of queries (default: %(default)s)")
    worst.add_argument(
        "--out", type=Path, default=Path("worst"), metavar="DIR", help="folder of results (default: %(default)s)"
    )
    worst.set_defaults(run=_worst)


def _add_calibrate(commands: Any) -> None:
    calibrate = commands.add_parser(
        "calibrate", help="fit a bundle's matching weights and confidence on generated validation homes"
    )
    add_options(calibrate, "--bundle")
    _generator_arguments(calibrate)
    calibrate.add_argument(
        "--openings-weight",
        type=positive,
        metavar="WEIGHT",
        help="weight of openings relative to walls, such as one tuned on photographs (default: fitted)",
    )
    calibrate.add_argument(
        "--tail",
        type=positive,
        metavar="FACTOR",
        help="scale of the errors of walls over the predicted one (default: the bundle's)",
    )
    calibrate.add_argument(
        "--keep-evidence", action="store_true", help="keep the bundle's matching weights and fit only confidence"
    )
    calibrate.add_argument(
        "--views", action="store_true", help="calibrate the encoder of views, on views of 55° to 110°, not on spheres"
    )
    calibrate.add_argument(
        "--turns",
        action="store_true",
        help="only fit the confidence of turns on the spot, on 2 turns of views and parts of them in each home",
    )
    calibrate.add_argument(
        "--errors", action="store_true", help="only measure the predictions' errors, for `plan check --localisability`"
    )
    calibrate.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to store predictions in and to continue from"
    )
    calibrate.set_defaults(run=_calibrate)


def _data_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, metavar="DIR", help="data set (default: generated homes)")
    parser.add_argument(
        "--dataset", choices=tuple(DATASET_FORMATS), help="format of the data set (default: detected from its files)"
    )
    parser.add_argument(
        "--generator",
        choices=("synth", "heldout"),
        default="synth",
        help="generator of homes: the one used in training, or out-of-distribution homes (default: %(default)s)",
    )
    _generator_arguments(parser)


def _generator_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--homes", type=count, default=100, help="number of generated homes, 4 queries each (default: %(default)s)"
    )
    add_options(parser, "--seed", "--textures")


def _evaluate(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.runs.evaluation import run_evaluation
    from lalaloc_core.evaluate.runs.factories import build_dataset, choose_appearance, describe_model
    from lalaloc_core.evaluate.runs.predictions import RunFolder, RunInfo
    from lalaloc_core.evaluate.runs.score import score_run

    method, panorama = arguments.method, arguments.kind == "panorama"
    bundle = None if method in ("oracle", "icp") else arguments.bundle
    _check_options(arguments)
    given = {"refine": arguments.refine, "heading_error_deg": arguments.heading_error}
    settings = {name: value for name, value in given.items() if value is not None}
    info = RunInfo(
        label=f"{method} albums" if arguments.albums else f"{method} {arguments.kind}",
        method=method,
        kind=arguments.kind,
        dataset="",
        split=arguments.split,
        settings=settings,
        views=None if arguments.view is None else {"field_deg": arguments.view},
        albums=arguments.albums,
        data=None if arguments.data is None else str(arguments.data),
        data_format=arguments.dataset,
        generated=_generated_homes(arguments) if arguments.data is None else None,
        heading_known=not arguments.albums and arguments.heading != "unknown",
        grid_step_m=arguments.grid_step,
        limit=arguments.limit,
        bundle=None if bundle is None else str(bundle),
        model=None if bundle is None else describe_model(bundle),
        skip_bad=arguments.skip_bad,
        command=shlex.join(["lalaloc", *sys.argv[1:]]),
    )
    dataset = build_dataset(info)
    appearance = choose_appearance(dataset, arguments.furniture, arguments.lighting)
    shown = {"furniture": appearance.furniture, "lighting": appearance.lighting} if panorama else {}
    info = replace(info, dataset=dataset.description, **shown)
    with tempfile.TemporaryDirectory(prefix="lalaloc-run-") as temporary:
        folder = RunFolder(arguments.out or Path(temporary))
        run_evaluation(folder, info, workers=arguments.workers)
        report = score_run(folder)
    if arguments.json:
        print_json(report, _DECIMALS)
    else:
        _print_scores(report)


def _check_options(arguments: argparse.Namespace) -> None:
    """Check that the options of `evaluate` belong together."""
    method, kind = arguments.method, arguments.kind
    photographs = kind == "panorama" and method == "lalaloc"
    if arguments.data is None and arguments.dataset is not None:
        raise InvalidInputError(f"--dataset {arguments.dataset} needs --data, which is missing")
    if arguments.data is not None and arguments.generator != "synth":
        raise InvalidInputError(f"--generator {arguments.generator} is for generated homes, not for --data")
    if arguments.refine is not None and method != "lalaloc":
        raise InvalidInputError(f"--refine {arguments.refine} is for method 'lalaloc', not '{method}'")
    for option, is_given in {"--view": arguments.view is not None, "--albums": arguments.albums}.items():
        if is_given and not photographs:
            raise InvalidInputError(f"{option} is for photographs and method 'lalaloc', not {method} {kind}")
    if arguments.albums and (arguments.heading == "known" or arguments.refine is not None):
        option = "--heading known" if arguments.heading == "known" else f"--refine {arguments.refine}"
        raise InvalidInputError(f"{option} is for photographs one by one; leave it out with --albums")
    if arguments.heading_error is not None and (
        arguments.view is None or arguments.albums or arguments.heading == "unknown"
    ):
        raise InvalidInputError("--heading-error is for --view with a known heading")


def _score(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.runs.predictions import RunFolder
    from lalaloc_core.evaluate.runs.score import score_run

    reports = {str(path): score_run(RunFolder(path)) for path in arguments.runs}
    if arguments.json:
        print_json(reports, _DECIMALS)
        return
    for path, report in reports.items():
        print(path)
        _print_scores(report)


def _print_scores(report: dict[str, Any]) -> None:
    """Print the main figures as a table; the run's folder and its report have all of them."""
    from lalaloc_core.evaluate.runs.score import MIN_QUERIES

    skipped = f", {report['skipped']} left out" if report["skipped"] else ""
    print(f"{report['label']}, {report['dataset']}: {report['n']} queries, {report['unanswered']} unanswered{skipped}")
    stages = {**report["stages"], "answer": report["final"]}
    print_table(
        ("stage", "median cm", "< 10 cm", "< 50 cm", "< 1 m", "< 1 m, 30°", "room", "heading < 2°", "median ms"),
        [
            (
                name,
                "-" if (median := scores["median_cm"]["value"]) is None else f"{median:.1f}",
                *(f"{100 * scores[share]['value']:.1f} %" for share in _SHARES),
                f"{report['median_ms'][name]:.0f}" if name in report["median_ms"] else "",
            )
            for name, scores in stages.items()
        ],
    )
    interval = report["final"]["within_1m"]
    if report["n"] < MIN_QUERIES:
        print(f"too few queries for an interval: {report['n']}; give at least {MIN_QUERIES}")
    else:
        print(f"answers within 1 m: 95 % interval {100 * interval['low']:.1f} to {100 * interval['high']:.1f} %")
    if report["calibration_error"] is not None:
        print(f"expected calibration error of the confidence: {report['calibration_error']:.3f}")
    if report["clicks_per_album"] is not None:
        print(f"expected calibration error of the room: {report['room_calibration_error']:.3f}")
        print(f"corrections of an album until all rooms are right: {report['clicks_per_album']:.1f}")


def _report(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.report import write_report

    write_report(arguments.runs, arguments.out, pictures=arguments.pictures)


def _worst(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.report.worst import write_worst

    print_json(write_worst(arguments.folder, arguments.out, arguments.count))


def _calibrate(arguments: argparse.Namespace) -> None:
    if arguments.errors:
        from lalaloc_core.evaluate.calibrate.measured_errors import calibrate_errors

        sphere, view = calibrate_errors(arguments.bundle, arguments.homes)
        print_json({"sphere_spread": sphere.spread, "view_spread": view.spread})
        return
    if arguments.turns:
        from lalaloc_core.evaluate.calibrate.turn_confidence import TurnSettings, calibrate_turns

        settings = TurnSettings(homes=arguments.homes, seed=arguments.seed, textures=arguments.textures)
        metrics = calibrate_turns(arguments.bundle, settings).manifest.metrics
        print_json({name: value for name, value in metrics.items() if name.startswith("turn_")})
        return
    from lalaloc_core.evaluate.calibrate.calibration import CalibrationConfig, calibrate

    names = [field.name for field in dataclasses.fields(CalibrationConfig)]
    config = CalibrationConfig(**{name: getattr(arguments, name) for name in names})
    manifest = calibrate(arguments.bundle, config).manifest
    print_json(dataclasses.asdict(manifest.evidence_for(view=arguments.views)))
    print_json(manifest.metrics)


def _generated_homes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the chosen generator as plain data."""
    generated = _generated(arguments, arguments.furniture or "full")
    if arguments.generator == "synth":
        return generated
    if arguments.textures is not None:
        raise InvalidInputError("--textures is for --generator synth; 'heldout' has materials of its own")
    if arguments.split == "train":
        raise InvalidInputError("--generator heldout has no split 'train'; choose --split validation or test")
    return {"generator": arguments.generator} | {name: generated[name] for name in ("homes", "seed", "furniture")}


def _generated(arguments: argparse.Namespace, furniture: str | None) -> dict[str, Any]:
    """Return arguments of `GeneratedScenes` as plain data."""
    return {
        "homes": arguments.homes,
        "seed": arguments.seed,
        "furniture": furniture,
        "textures": None if arguments.textures is None else str(arguments.textures),
    }
