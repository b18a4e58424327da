"""`lalaloc lab evaluate`, `score`, `report`, `worst` and `calibrate`."""

from __future__ import annotations

import dataclasses
import shlex
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from lalaloc_core.cli.lab import BundleFolder, Command, Seed, SkipBad, Textures, Workers, check_range
from lalaloc_core.cli.printing import print_json, print_table
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.files import default_bundle
from lalaloc_core.learn.dataset_names import HELDOUT_HOMES, Split

Homes = Annotated[int, "number of generated homes, 4 queries each"]
AsJson = Annotated[bool, "print all figures as JSON"]
Runs = Annotated[tuple[Path, ...], "folders of runs"]
# Decimals of printed scores; a run's folder has all.
_DECIMALS = 4
# Columns of the printed table.
_SHARES = ("within_10cm", "within_50cm", "within_1m", "within_1m_30deg", "correct_room", "heading_within_2deg")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Localise the queries of a data set or of generated homes, and score the answers."""

    bundle: BundleFolder = field(default_factory=default_bundle)
    method: Annotated[Literal["lalaloc", "oracle", "icp", "explicit", "decode"], "localisation method"] = "lalaloc"
    kind: Annotated[Literal["layout", "photograph"], "kind of query"] = "photograph"
    data: Annotated[Path | None, "data set (default: generated homes)"] = None
    dataset: Annotated[
        Literal["structured3d", "zind", "own", "annotated", "posed"] | None,
        "format of the data set (default: detected from its files)",
    ] = None
    generator: Annotated[
        Literal["synth", "heldout"], "generator of homes: the one used in training, or sixty out-of-distribution homes"
    ] = "synth"
    homes: Homes = 100
    seed: Seed = 0
    textures: Textures = None
    split: Annotated[Split, "split"] = "test"
    furniture: Annotated[Literal["empty", "simple", "full"] | None, "furniture level (default: by data set)"] = None
    lighting: Annotated[Literal["cold", "raw", "warm"] | None, "lighting (default: by data set)"] = None
    heading: Annotated[
        Literal["known", "unknown"] | None, "heading of queries (default: known; that of albums is unknown)"
    ] = None
    grid_step: Annotated[float, "step of the pose grid, metres"] = 0.5
    view: Annotated[float | None, "cut views of this field of view, degrees (default: whole spheres)"] = None
    heading_error: Annotated[float | None, "largest error of the known heading of views, degrees (default: 0)"] = None
    albums: Annotated[
        bool, "solve all photographs of a scene together, as `lalaloc pin`; files can be of any projection"
    ] = False
    refine: Annotated[Literal["none", "vdr", "lpo"] | None, "last stage of refinement (default: lpo)"] = None
    limit: Annotated[int | None, "maximum number of queries (default: all)"] = None
    skip_bad: SkipBad = False
    workers: Workers = None
    out: Annotated[Path | None, "folder of the run; an existing run is continued"] = None
    json: AsJson = False


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score the stored predictions of runs again, without model or data."""

    runs: Runs
    json: AsJson = False


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write a self-contained HTML report about runs."""

    runs: Runs
    out: Annotated[Path, "page to write"] = Path("report.html")
    pictures: Annotated[Path | None, "folder to write the page's charts to as well"] = None


@dataclass(frozen=True, kw_only=True)
class Worst:
    """List the worst queries of a run and count their properties."""

    folder: Annotated[Path, "folder of the run"]
    count: Annotated[int, "number of queries"] = 100
    out: Annotated[Path, "folder of results"] = Path("worst")


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Fit a bundle's matching weights and confidence on generated validation homes."""

    bundle: BundleFolder = field(default_factory=default_bundle)
    homes: Homes = 100
    seed: Seed = 0
    textures: Textures = None
    openings_weight: Annotated[
        float | None, "weight of openings relative to walls, such as one tuned on photographs (default: fitted)"
    ] = None
    tail: Annotated[float | None, "scale of the errors of walls over the predicted one (default: the bundle's)"] = None
    keep_evidence: Annotated[bool, "keep the bundle's matching weights and fit only confidence"] = False
    views: Annotated[bool, "calibrate the encoder of views, on views of 55° to 110°, not on spheres"] = False
    turns: Annotated[
        bool, "only fit the confidence of turns on the spot, on 2 turns of views and parts of them in each home"
    ] = False
    errors: Annotated[bool, "only measure the predictions' errors, for `plan check --localisability`"] = False
    out: Annotated[Path | None, "folder to store predictions in and to continue from"] = None


def _evaluate(arguments: Evaluate) -> None:
    check_range(arguments, 1, "homes", "limit")
    check_range(arguments, 0, "grid_step", "view", "heading_error", "workers")
    from lalaloc_core.evaluate.runs.evaluation import run_evaluation
    from lalaloc_core.evaluate.runs.factories import build_dataset, choose_appearance, describe_model
    from lalaloc_core.evaluate.runs.predictions import RunFolder, RunInfo
    from lalaloc_core.evaluate.runs.score import score_run

    method, is_photograph = arguments.method, arguments.kind == "photograph"
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
    shown = {"furniture": appearance.furniture, "lighting": appearance.lighting} if is_photograph else {}
    info = replace(info, dataset=dataset.description, **shown)
    with tempfile.TemporaryDirectory(prefix="lalaloc-run-") as temporary:
        folder = RunFolder(arguments.out or Path(temporary))
        run_evaluation(folder, info, workers=arguments.workers)
        report = score_run(folder)
    if arguments.json:
        print_json(report, _DECIMALS)
    else:
        _print_scores(report)


def _check_options(arguments: Evaluate) -> None:
    method, kind = arguments.method, arguments.kind
    photographs = kind == "photograph" and method == "lalaloc"
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


def _score(arguments: Score) -> None:
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


def _report(arguments: Report) -> None:
    from lalaloc_core.evaluate.report import write_report

    write_report(arguments.runs, arguments.out, pictures=arguments.pictures)


def _worst(arguments: Worst) -> None:
    check_range(arguments, 1, "count")
    from lalaloc_core.evaluate.report.worst import write_worst

    print_json(write_worst(arguments.folder, arguments.out, arguments.count))


def _calibrate(arguments: Calibrate) -> None:
    check_range(arguments, 1, "homes")
    check_range(arguments, 0, "openings_weight", "tail")
    if arguments.errors:
        from lalaloc_core.evaluate.calibrate.measured_errors import calibrate_errors

        sphere, view = calibrate_errors(arguments.bundle, arguments.homes)
        print_json({"sphere_spread": sphere.spread, "view_spread": view.spread})
        return
    from lalaloc_core.evaluate.calibrate.calibration import CalibrationConfig, calibrate

    names = [field.name for field in dataclasses.fields(CalibrationConfig)]
    config = CalibrationConfig(**{name: getattr(arguments, name) for name in names})
    if arguments.turns:
        from lalaloc_core.evaluate.calibrate.turn_confidence import calibrate_turns

        metrics = calibrate_turns(arguments.bundle, config).manifest.metrics
        print_json({name: value for name, value in metrics.items() if name.startswith("turn_")})
        return
    manifest = calibrate(arguments.bundle, config).manifest
    print_json(dataclasses.asdict(manifest.evidence_for(view=arguments.views)))
    print_json(manifest.metrics)


def _generated_homes(arguments: Evaluate) -> dict[str, Any]:
    """Return the arguments of the chosen generator as plain data."""
    if arguments.generator == "synth":
        return {
            "homes": arguments.homes,
            "seed": arguments.seed,
            "furniture": arguments.furniture or "full",
            "textures": None if arguments.textures is None else str(arguments.textures),
        }
    if arguments.textures is not None or arguments.seed != 0 or arguments.furniture not in (None, "full"):
        raise InvalidInputError(
            "--textures, --seed and --furniture are for --generator synth; homes of 'heldout' are furnished and fixed"
        )
    if arguments.split != "test":
        raise InvalidInputError(f"--generator heldout has no split '{arguments.split}'; choose --split test")
    return {"generator": arguments.generator, "homes": min(arguments.homes, HELDOUT_HOMES)}


COMMANDS = {
    "evaluate": Command(Evaluate, _evaluate, "data"),
    "score": Command(Score, _score, "runs"),
    "report": Command(Report, _report, "runs"),
    "worst": Command(Worst, _worst, "folder"),
    "calibrate": Command(Calibrate, _calibrate, "bundle"),
}
