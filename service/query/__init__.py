"""Queries: from a decoded request to the answer, in a plan or in plans of a venue.

Begin with `single_query.py`, whose `_search` shows the flow: photograph, ground, steps, answer. `sequence_query.py`
does the same for several photographs and `session_query.py` for the next photograph of a session, `album_search.py` for
albums; `localiser.py` calls them. `photograph_reader.py` decodes and encodes photographs. `grounds.py` reads what a
request states about the camera, waits for its plan or venue, and returns its `ground.py`. `executor.py` runs the steps,
`lpo_pool.py` the refinement in worker processes; the core composes the answer, and `answers.py` names its stored plans.
`geopose.py` translates answers. `queries.py` has the queries.
"""

from service.query.executor import Executor, Optimiser
from service.query.grounds import Grounds
from service.query.localiser import Localiser, LocalLocaliser
from service.query.lpo_pool import LpoPool
from service.query.photograph_reader import PhotographReader
from service.query.queries import (
    SOLVE_S,
    AlbumOutcome,
    AlbumPhotographQuery,
    AlbumProgress,
    AlbumQuery,
    AnyQuery,
    Content,
    PhotographQuery,
    PictureQuery,
    SequenceQuery,
    TrackQuery,
    Where,
)
from service.query.session_query import MAX_POSES
from service.query.single_query import QueryParts
from service.query_context import QueryContext
