"""The command line: `lalaloc train | export | calibrate | evaluate | bench | contact-sheet`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.errors import InvalidInputError, LaLaLocError

_SPLITS = {"validation": 1, "test": 2}


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 on success, 2 on the caller's mistake, 1 on any other error of this project."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except InvalidInputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except LaLaLocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="lalaloc", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train a stage: the layout encoder, then the image encoder")
    train.add_argument("stage", choices=("layout", "image"))
    train.add_argument("--preset", default="ring", choices=("ring", "paper", "tiny"))
    train.add_argument("--out", type=Path, required=True, help="folder of the run, shared by both stages")
    train.add_argument("--minutes", type=float, help="wall-clock budget; sets the pace of the schedule")
    train.add_argument("--steps", type=int, help="number of updates, instead of the preset's")
    train.add_argument("--seed", type=int, help="instead of the preset's")
    train.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")
    train.add_argument("--device", help="cpu or cuda; default: cuda where there is one")
    train.add_argument("--workers", type=int, default=1, help="processes that make training batches")
    train.add_argument("--textures", type=Path, help="folder of material pictures; without it all are procedural")
    train.set_defaults(run=_train)

    export = commands.add_parser("export", help="export a trained run to a model bundle")
    export.add_argument("--run", type=Path, required=True, dest="folder")
    export.add_argument("--out", type=Path, required=True)
    export.add_argument("--name", help="of the model; default: the name of the folder --out")
    export.add_argument("--version", required=True, dest="model_version")
    export.add_argument("--note", action="append", default=[], metavar="KEY=VALUE", help="recorded in the manifest")
    export.set_defaults(run=_export)

    calibrate = commands.add_parser("calibrate", help="fit a bundle's confidence on validation homes")
    _query_arguments(calibrate, homes=100)
    calibrate.set_defaults(run=_calibrate)

    evaluate = commands.add_parser("evaluate", help="localise synthetic queries with a bundle and score the answers")
    _query_arguments(evaluate, homes=100)
    evaluate.add_argument("--kind", choices=("layout", "panorama"), default="panorama")
    evaluate.add_argument("--split", choices=tuple(_SPLITS), default="test")
    evaluate.add_argument("--furniture", choices=("empty", "simple", "full"), default="full")
    evaluate.add_argument("--heading", choices=("known", "unknown"), default="known")
    evaluate.set_defaults(run=_evaluate)

    bench = commands.add_parser("bench", help="measure the figures of docs/results.md and print them as JSON")
    bench.add_argument("--bundle", type=Path, default=Path("models/default"))
    bench.add_argument("--homes", type=int, default=125, help="test homes per accuracy figure, 4 queries each")
    bench.add_argument("--textures", type=Path, help="folder of material pictures for the test panoramas")
    bench.add_argument("--out", type=Path, help="also write the JSON to this file")
    bench.add_argument("--only", choices=("rendering", "service", "accuracy"), help="one group of figures")
    bench.set_defaults(run=_bench)

    sheet = commands.add_parser("contact-sheet", help="write a sheet of synthetic panoramas to look at")
    sheet.add_argument("--out", type=Path, default=Path("docs/contact_sheet.jpg"))
    sheet.add_argument("--seed", type=int, default=0)
    sheet.add_argument("--textures", type=Path)
    sheet.set_defaults(run=_contact_sheet)
    return parser


def _query_arguments(parser: argparse.ArgumentParser, homes: int) -> None:
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--homes", type=int, default=homes, help="number of synthetic homes, 4 queries each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--textures", type=Path, help="folder of material pictures")


def _train(arguments: argparse.Namespace) -> None:
    import torch

    from lalaloc_core.training.config import PRESETS
    from lalaloc_core.training.run import train_image, train_layout

    config = PRESETS[arguments.preset]
    changes: dict[str, Any] = {name: getattr(arguments, name) for name in ("minutes", "steps")}
    stage = dataclasses.replace(
        getattr(config, arguments.stage), **{name: value for name, value in changes.items() if value is not None}
    )
    config = dataclasses.replace(config, **{arguments.stage: stage})
    if arguments.seed is not None:
        config = dataclasses.replace(config, seed=arguments.seed)
    device = torch.device(arguments.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if device.type == "cpu":
        # The workers need cores of their own: threads that wait for each other on shared ones are slower than fewer.
        torch.set_num_threads(max((os.cpu_count() or 1) - arguments.workers, 1))
    common = {"device": device, "workers": arguments.workers, "resume": arguments.resume}
    if arguments.stage == "layout":
        train_layout(config, arguments.out, **common)
    else:
        train_image(config, arguments.out, textures=arguments.textures, **common)


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.training.run import export_run

    pairs = [note.partition("=") for note in arguments.note]
    notes = {"hardware": platform.machine(), **{key: value for key, _, value in pairs}}
    name = arguments.name or arguments.out.resolve().name
    bundle = export_run(arguments.folder, arguments.out, name=name, version=arguments.model_version, notes=notes)
    _print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})


def _calibrate(arguments: argparse.Namespace) -> None:
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.calibrate import calibrate
    from lalaloc_core.evaluate import QuerySet, summarise

    bundle = Bundle.open(arguments.bundle)
    queries = QuerySet(
        split=_SPLITS["validation"],
        homes=arguments.homes,
        seed=arguments.seed,
        furniture=None,
        textures=arguments.textures,
    )
    # One model serves both kinds of query, so it is fitted on both.
    results = [
        result
        for heading_known in (True, False)
        for result in _answers(bundle, queries, kind="panorama", heading_known=heading_known)
    ]
    description = (
        f"{len(results)} panoramas of {queries.homes} validation homes, all furniture levels, "
        "half with known and half with unknown heading"
    )
    calibrate(bundle, results, description)
    _print_json(summarise(results))


def _evaluate(arguments: argparse.Namespace) -> None:
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.evaluate import QuerySet, summarise

    queries = QuerySet(
        split=_SPLITS[arguments.split],
        homes=arguments.homes,
        seed=arguments.seed,
        furniture=arguments.furniture,
        textures=arguments.textures,
    )
    known = arguments.heading == "known"
    results = _answers(Bundle.open(arguments.bundle), queries, kind=arguments.kind, heading_known=known)
    _print_json({"command": shlex.join(sys.argv), **summarise(results)})


def _answers(bundle: Any, queries: Any, *, kind: Any, heading_known: bool) -> list[Any]:
    from lalaloc_core.evaluate import evaluate, local_refiner
    from lalaloc_core.localise.encoders import Encoders

    refiner = local_refiner(bundle)
    return evaluate(Encoders(bundle), queries, kind=kind, heading_known=heading_known, refiner=refiner)


def _bench(arguments: argparse.Namespace) -> None:
    from lalaloc_core.bench import run_bench

    groups = (arguments.only,) if arguments.only else ("rendering", "service", "accuracy")
    report = run_bench(arguments.bundle, groups, homes=arguments.homes, textures=arguments.textures)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    _print_json(report)


def _contact_sheet(arguments: argparse.Namespace) -> None:
    import numpy as np

    from lalaloc_core.synth.gallery import contact_sheet

    contact_sheet(arguments.out, np.random.default_rng(arguments.seed), arguments.textures)


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2))
