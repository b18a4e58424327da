"""`lalaloc evaluate` and `lalaloc calibrate`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.printing import print_json

_SPLITS = {"validation": 1, "test": 2}


def add_commands(commands: Any) -> None:
    """Add this room's commands to the parser."""
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


def _query_arguments(parser: argparse.ArgumentParser, homes: int) -> None:
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--homes", type=int, default=homes, help="number of synthetic homes, 4 queries each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--textures", type=Path, help="folder of material pictures")


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
    print_json(summarise(results))


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
    print_json({"command": shlex.join(sys.argv), **summarise(results)})


def _answers(bundle: Any, queries: Any, *, kind: Any, heading_known: bool) -> list[Any]:
    from lalaloc_core.evaluate import evaluate, local_refiner
    from lalaloc_core.localise.encoders import Encoders

    refiner = local_refiner(bundle)
    return evaluate(Encoders(bundle), queries, kind=kind, heading_known=heading_known, refiner=refiner)
