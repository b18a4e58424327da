"""`lalaloc train` and `lalaloc export`."""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import json
import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.options import add_options, count, processes
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidInputError

if TYPE_CHECKING:
    from lalaloc_core.learn.training.config import TrainConfig

# Four panoramas each; rendering one takes a third of a second, and validation uses all of them every few minutes.
_VALIDATION_HOMES = 50
# Ratio of validation homes to out-of-distribution homes, which take longer to render.
_PER_HELDOUT_HOME = 3
# Parameters of glibc (malloc.h): size from which blocks are mapped, and free memory that is kept.
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    _add_train(commands)
    _add_export(commands)
    _add_export_again(commands)
    _add_add_objects(commands)


def _add_train(commands: Any) -> None:
    train = commands.add_parser("train", help="train a stage: the layout encoder, then the image encoder")
    train.add_argument(
        "stage",
        choices=("layout", "image", "view", "end-to-end"),
        help="stage to train: the encoder of layouts, of spheres, of views (preset trunk), or the first two at once",
    )
    train.add_argument(
        "--preset",
        default="ring",
        choices=("ring", "trunk", "paper", "tiny", "tiny-trunk"),
        help="networks and schedule (default: %(default)s)",
    )
    train.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the run, shared by both stages"
    )
    train.add_argument("--data", type=Path, metavar="DIR", help="data set (default: homes generated during training)")
    add_options(train, "--skip-bad", "--textures")
    train.add_argument("--minutes", type=float, help="training time, instead of --steps")
    train.add_argument("--steps", type=int, help="number of updates (default: the preset's)")
    train.add_argument("--seed", type=int, help="random seed (default: the preset's)")
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="change a setting of the preset, such as image.uses_per_panorama=4 or image.supersample=[2,1]",
    )
    train.add_argument(
        "--from",
        type=Path,
        metavar="DIR",
        dest="init_from",
        help="start from the weights of a bundle or of another run (default: random weights)",
    )
    train.add_argument(
        "--layout-from",
        type=Path,
        metavar="DIR",
        help="image stage: bundle or run with the layout encoder to use if --out has none",
    )
    train.add_argument(
        "--photographs",
        type=Path,
        action="append",
        metavar="DIR",
        help="image stages: folder of panoramas; --teacher predicts walls and openings of those without an annotation; "
        "may be repeated (preset trunk)",
    )
    train.add_argument(
        "--teacher",
        type=Path,
        action="append",
        metavar="PATH",
        help="TensorFlow Lite segmenter with ADE20K's classes, or bundle whose encoder of spheres reads them; "
        "may be repeated for one of each",
    )
    train.add_argument("--resume", action="store_true", help="continue from the checkpoint in --out")
    train.add_argument("--device", help="cpu or cuda (default: cuda if available)")
    train.add_argument(
        "--workers", type=processes, default=1, help="processes that make batches; 0 uses none (default: %(default)s)"
    )
    train.add_argument(
        "--render",
        choices=("workers", "device"),
        help="renderer of generated homes: the worker processes, or --device, which then receives scenes instead of "
        "pixels (default: device if it is a GPU)",
    )
    train.add_argument(
        "--validation-homes",
        type=count,
        default=_VALIDATION_HOMES,
        metavar="N",
        help="maximum number of homes or scenes for validation (default: %(default)s)",
    )
    train.set_defaults(run=_train)


def _add_export(commands: Any) -> None:
    export = commands.add_parser("export", help="export a trained run to a model bundle")
    export.add_argument("--run", type=Path, required=True, dest="folder", metavar="DIR", help="folder of the run")
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the bundle")
    export.add_argument("--name", help="name of the model (default: name of the folder --out)")
    export.add_argument("--version", required=True, dest="model_version", help="version of the model")
    export.add_argument("--note", action="append", default=[], metavar="KEY=VALUE", help="note for the manifest")
    export.add_argument(
        "--into",
        "--views-of",
        type=Path,
        metavar="BUNDLE",
        help="copy this bundle with the run's encoder of spheres or of views in place of its own; calibrate the copy",
    )
    export.add_argument("--last", action="store_true", help="export the last weights instead of the best by validation")
    export.set_defaults(run=_export)


def _add_export_again(commands: Any) -> None:
    again = commands.add_parser("export-again", help="export the networks of a model bundle again from its own weights")
    again.add_argument("bundle", type=Path, help="folder of the bundle")
    again.set_defaults(run=_export_again)


def _add_add_objects(commands: Any) -> None:
    objects = commands.add_parser(
        "add-objects", help="add the pretrained classifier of objects, which tells types of rooms, to a model bundle"
    )
    objects.add_argument("bundle", type=Path, help="folder of the bundle")
    objects.set_defaults(run=_add_objects)


def _train(arguments: argparse.Namespace) -> None:
    import torch

    from lalaloc_core.learn.data.dataset_detection import open_dataset
    from lalaloc_core.learn.data.synthetic.heldout import HeldoutScenes
    from lalaloc_core.learn.training.run import train_stage
    from lalaloc_core.learn.training.training_data import TrainingData

    _check_train_options(arguments)
    config = _train_config(arguments)
    device = torch.device(arguments.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if device.type == "cpu":
        # Workers need cores of their own: threads that share cores are slower than fewer threads.
        torch.set_num_threads(max((os.cpu_count() or 1) - arguments.workers, 1))
        _keep_freed_memory()
    render = arguments.render or ("workers" if device.type == "cpu" else "device")
    heldout_homes = max(arguments.validation_homes // _PER_HELDOUT_HOME, 1)
    data = TrainingData(
        dataset=None if arguments.data is None else open_dataset(arguments.data),
        skip_bad=arguments.skip_bad,
        textures=arguments.textures,
        deferred=arguments.data is None and render == "device",
        validation_scenes=arguments.validation_homes,
        heldout=None if arguments.data is not None else HeldoutScenes(homes=heldout_homes),
        photographs=tuple(arguments.photographs or ()),
        teachers=tuple(arguments.teacher or ()),
    )
    train_stage(
        arguments.stage,
        config,
        arguments.out,
        device=device,
        data=data,
        workers=arguments.workers,
        resume=arguments.resume,
        init_from=arguments.init_from,
        layout_from=arguments.layout_from,
    )


def _check_train_options(arguments: argparse.Namespace) -> None:
    """Check that the options of `train` belong together."""
    if arguments.data is not None and arguments.textures is not None:
        raise InvalidInputError("--textures is for generated homes, not for --data")
    if arguments.data is None and arguments.skip_bad:
        raise InvalidInputError("--skip-bad is for --data")
    if arguments.data is not None and arguments.render is not None:
        raise InvalidInputError("--render is for generated homes, not for --data")
    if arguments.init_from is not None and (arguments.resume or arguments.stage == "end-to-end"):
        raise InvalidInputError("--from starts a new run of one stage; it excludes --resume and end-to-end")
    for option, name, stages in (
        ("--layout-from", "layout_from", ("image",)),
        ("--photographs", "photographs", ("image", "view")),
        ("--teacher", "teacher", ("image", "view")),
    ):
        if arguments.stage not in stages and getattr(arguments, name) is not None:
            raise InvalidInputError(f"{option} is for the stage {' or '.join(stages)}, not for '{arguments.stage}'")


def _train_config(arguments: argparse.Namespace) -> TrainConfig:
    """Return the preset with the settings, schedule and seed of the options."""
    from lalaloc_core.learn.training.presets import PRESETS

    config = PRESETS[arguments.preset].with_settings(_settings(arguments.settings))
    # End-to-end training takes its schedule from the image stage.
    part = "layout" if arguments.stage == "layout" else "image"
    given = {name: getattr(arguments, name) for name in ("minutes", "steps")}
    schedule = {name: value for name, value in given.items() if value is not None}
    changes: dict[str, Any] = {part: dataclasses.replace(getattr(config, part), **schedule)}
    if arguments.seed is not None:
        changes["seed"] = arguments.seed
    return dataclasses.replace(config, **changes)


def _keep_freed_memory() -> None:
    """Let glibc keep what a step frees for the next one: returned to the system, it comes back by slow page faults."""
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, 2**30)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _settings(pairs: list[str]) -> dict[str, Any]:
    """Parse settings by path; values are JSON, other words are text."""
    settings = {}
    for pair in pairs:
        path, equals, value = pair.partition("=")
        if not equals:
            raise InvalidInputError(f"--set is '{pair}'; it must be KEY=VALUE")
        try:
            settings[path] = json.loads(value)
        except ValueError:
            settings[path] = value
    return settings


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.learn.export.run_export import export_into, export_run

    pairs = [note.partition("=") for note in arguments.note]
    notes = {"hardware": platform.machine(), **{key: value for key, _, value in pairs}}
    given: dict[str, Any] = {"version": arguments.model_version, "notes": notes, "last": arguments.last}
    if arguments.into is not None:
        if arguments.name is not None:
            raise InvalidInputError(f"--name is '{arguments.name}'; a copy of --into keeps its name")
        bundle = export_into(arguments.into, arguments.folder, arguments.out, **given)
    else:
        name = arguments.name or arguments.out.resolve().name
        bundle = export_run(arguments.folder, arguments.out, name=name, **given)
    print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})


def _export_again(arguments: argparse.Namespace) -> None:
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.learn.export.run_export import reexport_bundle

    before = Bundle.open(arguments.bundle)
    after = reexport_bundle(arguments.bundle)
    print_json({"before": before.sha256, "after": after.sha256})


def _add_objects(arguments: argparse.Namespace) -> None:
    from lalaloc_core.learn.export.run_export import add_objects

    bundle = add_objects(arguments.bundle)
    print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})
