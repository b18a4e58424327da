"""The HTTP routes: each module makes one router.

Begin with `localise.py`, the query. `dependencies.py` has what routes about plans share, `plan_answers.py` says plans
in the words of the API.
"""

from service.routes import (
    floorplans,
    geopose,
    health,
    kept_answers,
    limits,
    localise,
    localise_sequence,
    pages,
    plan_events,
    plan_files,
    plan_layout,
    venues,
)

# In the order in which the API description has them.
ROUTERS = tuple(
    module.router
    for module in (
        floorplans,
        plan_files,
        plan_layout,
        plan_events,
        venues,
        localise,
        localise_sequence,
        geopose,
        kept_answers,
        health,
        limits,
        pages,
    )
)

__all__ = ["ROUTERS"]
