"""`lalaloc train` and `lalaloc export`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.bundle import Bundle

# Four panoramas each; drawing one takes a third of a second, and validation shows all of them every few minutes.
_VALIDATION_HOMES = 50
# So many validation homes for one that is out of the family, which takes longer to draw.
_PER_HELDOUT_HOME = 3


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    train = commands.add_parser("train", help="train a stage: the layout encoder, then the image encoder")
    train.add_argument("stage", choices=("layout", "image", "end-to-end"), help="end-to-end is both stages at once")
    train.add_argument("--preset", default="ring", choices=("ring", "trunk", "paper", "tiny", "tiny-trunk"))
    train.add_argument("--out", type=Path, required=True, help="folder of the run, shared by both stages")
    train.add_argument("--data", type=Path, metavar="DIR", help="a data set; default: homes drawn while training")
    train.add_argument("--skip-bad", action="store_true", help="pass over files that cannot be used, naming each once")
    train.add_argument("--minutes", type=float, help="wall-clock budget; sets the pace of the schedule")
    train.add_argument("--steps", type=int, help="number of updates, instead of the preset's")
    train.add_argument("--seed", type=int, help="instead of the preset's")
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="replace one setting of the preset, such as image.uses_per_panorama=4 or image.supersample=[2,1]",
    )
    train.add_argument(
        "--from",
        type=Path,
        metavar="DIR",
        dest="init_from",
        help="begin with the weights of a bundle or of another run, instead of fresh ones",
    )
    train.add_argument(
        "--layout-from",
        type=Path,
        metavar="DIR",
        help="image stage: a bundle or another run whose layout encoder to follow, where --out has none",
    )
    train.add_argument(
        "--photographs",
        type=Path,
        metavar="DIR",
        help="image stage: panoramas without labels, whose walls and openings --teacher tells (preset trunk)",
    )
    train.add_argument("--teacher", type=Path, metavar="FILE", help="TensorFlow Lite segmenter of ADE20K's classes")
    train.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")
    train.add_argument("--device", help="cpu or cuda; default: cuda where there is one")
    train.add_argument("--workers", type=int, default=1, help="processes that make batches; 0: none")
    train.add_argument(
        "--render",
        choices=("workers", "device"),
        help="where generated homes are photographed: by the processes that make batches, or on --device, which they "
        "then send scenes instead of pixels; default: on the device if it is a GPU",
    )
    train.add_argument(
        "--validation-homes",
        type=int,
        default=_VALIDATION_HOMES,
        metavar="N",
        help="validate on at most so many homes or scenes (default: %(default)s)",
    )
    train.add_argument("--textures", type=Path, help="folder of material pictures; without it all are procedural")
    train.set_defaults(run=_train)

    export = commands.add_parser("export", help="export a trained run to a model bundle")
    export.add_argument("--run", type=Path, required=True, dest="folder")
    export.add_argument("--out", type=Path, required=True)
    export.add_argument("--name", help="of the model; default: the name of the folder --out")
    export.add_argument("--version", required=True, dest="model_version")
    export.add_argument("--note", action="append", default=[], metavar="KEY=VALUE", help="recorded in the manifest")
    export.add_argument("--last", action="store_true", help="the last weights, instead of the best by validation")
    export.set_defaults(run=_export)

    again = commands.add_parser("export-again", help="write the networks of a model bundle anew, of its own weights")
    again.add_argument("bundle", type=Path, help="folder of the bundle")
    again.set_defaults(run=_export_again)


def _train(arguments: argparse.Namespace) -> None:
    import torch

    from lalaloc_core.learn.data.dataset_detection import open_dataset
    from lalaloc_core.learn.data.synthetic.heldout import HeldoutScenes
    from lalaloc_core.learn.training.data import TrainingData
    from lalaloc_core.learn.training.presets import PRESETS
    from lalaloc_core.learn.training.run import train_end_to_end, train_image, train_layout

    if arguments.data is not None and arguments.textures is not None:
        raise InvalidInputError("--textures is for generated homes, not for --data")
    if arguments.data is None and arguments.skip_bad:
        raise InvalidInputError("--skip-bad is for --data")
    if arguments.data is not None and arguments.render is not None:
        raise InvalidInputError("--render is for generated homes, not for --data")
    if arguments.init_from is not None and (arguments.resume or arguments.stage == "end-to-end"):
        raise InvalidInputError("--from is for a run of one stage that begins, neither for --resume nor for end-to-end")
    image_only = {"--layout-from": "layout_from", "--photographs": "photographs", "--teacher": "teacher"}
    for option, name in image_only.items():
        if arguments.stage != "image" and getattr(arguments, name) is not None:
            raise InvalidInputError(f"{option} is for the stage 'image', not for '{arguments.stage}'")
    config = PRESETS[arguments.preset].with_settings(_settings(arguments.settings))
    # End-to-end training takes its schedule from the image stage.
    part = "layout" if arguments.stage == "layout" else "image"
    changes: dict[str, Any] = {name: getattr(arguments, name) for name in ("minutes", "steps")}
    stage = dataclasses.replace(
        getattr(config, part), **{name: value for name, value in changes.items() if value is not None}
    )
    config = dataclasses.replace(config, **{part: stage})
    if arguments.seed is not None:
        config = dataclasses.replace(config, seed=arguments.seed)
    device = torch.device(arguments.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if device.type == "cpu":
        # The workers need cores of their own: threads that wait for each other on shared ones are slower than fewer.
        torch.set_num_threads(max((os.cpu_count() or 1) - arguments.workers, 1))
    if arguments.workers < 0:
        raise InvalidInputError(f"--workers {arguments.workers}: at least 0 is needed")
    if arguments.validation_homes < 1:
        raise InvalidInputError(f"--validation-homes {arguments.validation_homes}: at least 1 is needed")
    render = arguments.render or ("workers" if device.type == "cpu" else "device")
    heldout_homes = max(arguments.validation_homes // _PER_HELDOUT_HOME, 1)
    data = TrainingData(
        dataset=None if arguments.data is None else open_dataset(arguments.data),
        skip_bad=arguments.skip_bad,
        textures=arguments.textures,
        deferred=arguments.data is None and render == "device",
        validation_scenes=arguments.validation_homes,
        heldout=None if arguments.data is not None else HeldoutScenes(homes=heldout_homes),
        photographs=arguments.photographs,
        segmenter=arguments.teacher,
    )
    train: Callable[..., Any] = {"layout": train_layout, "image": train_image, "end-to-end": train_end_to_end}[
        arguments.stage
    ]
    optional = {name: getattr(arguments, name) for name in ("init_from", "layout_from")}
    given = {name: value for name, value in optional.items() if value is not None}
    train(config, arguments.out, device=device, data=data, workers=arguments.workers, resume=arguments.resume, **given)


def _settings(pairs: list[str]) -> dict[str, Any]:
    """Settings by path; values are JSON, and plain words are text."""
    settings = {}
    for pair in pairs:
        path, equals, value = pair.partition("=")
        if not equals:
            raise InvalidInputError(f"--set {pair}: KEY=VALUE is wanted")
        try:
            settings[path] = json.loads(value)
        except ValueError:
            settings[path] = value
    return settings


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.learn.export.run import export_run

    pairs = [note.partition("=") for note in arguments.note]
    notes = {"hardware": platform.machine(), **{key: value for key, _, value in pairs}}
    name = arguments.name or arguments.out.resolve().name
    bundle = export_run(
        arguments.folder, arguments.out, name=name, version=arguments.model_version, notes=notes, last=arguments.last
    )
    print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})


def _export_again(arguments: argparse.Namespace) -> None:
    from lalaloc_core.learn.export.run import export_bundle_again

    before = Bundle.open(arguments.bundle)
    after = export_bundle_again(arguments.bundle)
    print_json({"before": before.sha256, "after": after.sha256})
