"""Pose grids of plans: read from memory or the store, or computed by one replica for all.

Begin with `grid_provider.py`, the interface for all other packages. `builder.py` computes the grids that `grid_jobs.py`
queues, under leases, and `sweeper.py` reacts to other replicas.
"""

from service.grids.grid_provider import GridProvider, GridState, check_height_m, grid_height_m
from service.grids.sweeper import Sweeper
