"""`lalaloc synth` and `lalaloc contact-sheet`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.options import add_options
from lalaloc_core.learn.dataset_names import SPLITS


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    synth = commands.add_parser("synth", help="write synthetic scenes in Structured3D's layout")
    synth.add_argument("--scenes", type=int, required=True, help="number of scenes in total; existing ones are kept")
    synth.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the data set")
    synth.add_argument("--split", choices=("all", *SPLITS), default="all", help="split (default: %(default)s)")
    synth.add_argument(
        "--height", type=int, default=256, help="height of a panorama in pixels, half its width (default: %(default)s)"
    )
    add_options(synth, "--seed", "--textures")
    synth.add_argument("--workers", type=int, default=1, help="rendering processes (default: %(default)s)")
    synth.set_defaults(run=_synth)

    sheet = commands.add_parser("contact-sheet", help="write a picture with examples of synthetic panoramas")
    sheet.add_argument(
        "--out",
        type=Path,
        default=Path("contact_sheet.jpg"),
        metavar="FILE",
        help="picture to write (default: %(default)s)",
    )
    add_options(sheet, "--seed", "--textures")
    sheet.set_defaults(run=_contact_sheet)


def _synth(arguments: argparse.Namespace) -> None:
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


def _contact_sheet(arguments: argparse.Namespace) -> None:
    import numpy as np

    from lalaloc_core.learn.synth.rendering.panorama import contact_sheet

    contact_sheet(arguments.out, np.random.default_rng(arguments.seed), arguments.textures)
