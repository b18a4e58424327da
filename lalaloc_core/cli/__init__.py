"""The command line, `lalaloc`; each module here adds one group of commands.

Begin with `localising.py`, which answers, and `evaluation.py`, which has the most of them; `entry_point.py` puts the
groups together. Commands import what they run when they run it, so that `lalaloc --help` loads no network.
"""

from lalaloc_core.cli.entry_point import main

__all__ = ["main"]
