"""Latent grids of plans: found in memory or in the store, computed by one replica for all of them.

Begin with `grid_provider.py`, which everybody else asks. `builder.py` computes what `grid_jobs.py` queues, under
leases; `throttle.py` lets queries go first, and `sweeper.py` looks after what other replicas did.
"""

from service.grids.grid_provider import GridProvider, GridState
from service.grids.heights import check_height_m, grid_height_m
from service.grids.sweeper import Sweeper

__all__ = ["GridProvider", "GridState", "Sweeper", "check_height_m", "grid_height_m"]
