"""Procedural homes: rooms, doors and windows.

Begin with `plans.py`, which draws a home: `partition.py` divides it into rooms, `openings.py` connects them.
Homes are numbered by split. Needs no torch.
"""

from lalaloc_core.learn.synth.homes.openings import Opening, OpeningKind
from lalaloc_core.learn.synth.homes.plans import Home
