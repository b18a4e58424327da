"""`lalaloc contact-sheet`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_commands(commands: Any) -> None:
    """Add this room's commands to the parser."""
    sheet = commands.add_parser("contact-sheet", help="write a sheet of synthetic panoramas to look at")
    sheet.add_argument("--out", type=Path, default=Path("docs/contact_sheet.jpg"))
    sheet.add_argument("--seed", type=int, default=0)
    sheet.add_argument("--textures", type=Path)
    sheet.set_defaults(run=_contact_sheet)


def _contact_sheet(arguments: argparse.Namespace) -> None:
    import numpy as np

    from lalaloc_core.synth.gallery import contact_sheet

    contact_sheet(arguments.out, np.random.default_rng(arguments.seed), arguments.textures)
