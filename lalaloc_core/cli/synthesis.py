"""`lalaloc lab synth`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from lalaloc_core.cli.lab import Command, Seed, Textures
from lalaloc_core.learn.dataset_names import Split


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


COMMANDS = {"synth": Command(Synth, _synth, "out")}
