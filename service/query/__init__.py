"""Queries: from a decoded request to the answer, in one plan or in all plans of a venue.

Begin with `localiser.py`, whose `_localise` shows the steps in order; `search_steps.py` runs them. `sequences.py`
answers queries of several photographs. `stated_pose.py` reads the fields about the camera, `photographs.py` encodes
decoded photographs, `answers.py` composes the answer. `venue_localiser.py` does the same for a venue: `venue_search.py`
waits for its plans (`plan_list.py`), `venue_plans.py` chooses among them by an index (`plan_indices.py`) of the
prototypes in `prototype_file.py`, and `venue_hints.py` applies the hints to them. `tracking.py` follows the cameras of
sessions in the plans of `grounds.py`. `decoding.py` and `lpo_pool.py` are pools of worker processes. `queries.py` has
the queries and the interfaces of the components that can run in other processes.
"""

from service.decoding.decoder import Decoder
from service.query.grounds import MAX_POSES, Grounds
from service.query.localiser import Localiser
from service.query.lpo_pool import LpoPool
from service.query.queries import (
    Content,
    LocaliserBackend,
    OptimiserBackend,
    PhotographQuery,
    PictureRequest,
    QueryContext,
    SequenceQuery,
    TrackerBackend,
    TrackOutcome,
    TrackQuery,
    VenueLocaliserBackend,
)
from service.query.tracking import SessionTracker
from service.query.venue_localiser import VenueLocaliser
from service.venues.plan_indices import IndexSource, PlanIndices
from service.venues.venue_plans import VenuePlans
from service.venues.venue_search import VenueSearch

__all__ = [
    "MAX_POSES",
    "Content",
    "Decoder",
    "Grounds",
    "IndexSource",
    "Localiser",
    "LocaliserBackend",
    "LpoPool",
    "OptimiserBackend",
    "PhotographQuery",
    "PictureRequest",
    "PlanIndices",
    "QueryContext",
    "SequenceQuery",
    "SessionTracker",
    "TrackOutcome",
    "TrackQuery",
    "TrackerBackend",
    "VenueLocaliser",
    "VenueLocaliserBackend",
    "VenuePlans",
    "VenueSearch",
]
