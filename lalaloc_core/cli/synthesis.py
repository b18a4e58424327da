"""`lalaloc synth` and `lalaloc contact-sheet`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.learn.data.dataset import SPLITS

# What shells say of a command that Ctrl-C ended.
_INTERRUPTED = 130


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    synth = commands.add_parser("synth", help="write synthetic scenes in Structured3D's layout")
    synth.add_argument("--scenes", type=int, required=True, help="how many there shall be; those that are stay")
    synth.add_argument("--out", type=Path, required=True, help="folder of the data set")
    synth.add_argument("--split", choices=("all", *SPLITS), default="all")
    synth.add_argument("--seed", type=int, default=0)
    synth.add_argument("--height", type=int, default=256, help="rows of a panorama, which is twice as wide")
    synth.add_argument("--textures", type=Path, help="folder of material pictures")
    synth.add_argument("--workers", type=int, default=1, help="processes that render")
    synth.set_defaults(run=_synth)

    sheet = commands.add_parser("contact-sheet", help="write a sheet of synthetic panoramas to look at")
    sheet.add_argument("--out", type=Path, default=Path("contact_sheet.jpg"))
    sheet.add_argument("--seed", type=int, default=0)
    sheet.add_argument("--textures", type=Path)
    sheet.set_defaults(run=_contact_sheet)


def _synth(arguments: argparse.Namespace) -> None:
    from lalaloc_core.learn.data.synthetic.writing import Synthesis, share_out, synthesise

    settings = Synthesis(root=arguments.out, seed=arguments.seed, height=arguments.height, textures=arguments.textures)
    numbers = share_out(arguments.scenes, arguments.split)
    try:
        written = synthesise(settings, numbers, workers=arguments.workers)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on where it stopped", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None
    counts = ", ".join(f"{len(of_split)} {split}" for split, of_split in numbers.items())
    print(f"{arguments.out}: {counts}; {written} of them new")


def _contact_sheet(arguments: argparse.Namespace) -> None:
    import numpy as np

    from lalaloc_core.learn.synth.rendering.contact_sheet import contact_sheet

    contact_sheet(arguments.out, np.random.default_rng(arguments.seed), arguments.textures)
