"""Command line `lalaloc`; each module adds one group of commands.

Begin with `entry_point.py`, which assembles the groups; `localising.py` has the main command. Commands import their
implementation when they run, so `lalaloc --help` loads no array and no network.
"""

from lalaloc_core.cli.entry_point import main
