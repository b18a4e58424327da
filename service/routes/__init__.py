"""HTTP routes, one router per module.

Begin with `localise.py`, the query. `dependencies.py` has the dependencies and look-ups that routes share,
`plan_answers.py` turns stored plans into answers.
"""

from service.routes import (
    admin,
    floorplans,
    geopose,
    health,
    kept_answers,
    limits,
    localise,
    localise_batch,
    localise_sequence,
    model_files,
    pages,
    plan_events,
    plan_files,
    plan_layout,
    session_stream,
    sessions,
    venues,
)

# In the order of the API description.
ROUTERS = tuple(
    module.router
    for module in (
        floorplans,
        plan_files,
        plan_layout,
        plan_events,
        venues,
        localise,
        localise_batch,
        localise_sequence,
        sessions,
        session_stream,
        geopose,
        model_files,
        kept_answers,
        health,
        limits,
        admin,
        pages,
    )
)

__all__ = ["ROUTERS"]
