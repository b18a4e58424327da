"""HTTP routes, one router per module.

Begin with `localise.py`, the query. `dependencies.py` has the request as routes take it, with the running service, the
caller and look-ups; `descriptions.py` has the errors, headers and bodies that the API description repeats.
"""

from service.routes import (
    admin,
    album_copies,
    album_photographs,
    albums,
    floorplans,
    localise,
    localise_sequence,
    model_files,
    pages,
    plan_files,
    service_state,
    sessions,
    venues,
)

# In the order of the API description.
ROUTERS = tuple(
    module.router
    for module in (
        floorplans,
        plan_files,
        venues,
        localise,
        localise_sequence,
        sessions,
        albums,
        album_photographs,
        album_copies,
        model_files,
        service_state,
        admin,
        pages,
    )
)
