"""What answers a panorama: decoding it, and the search with the optimiser in worker processes.

Begin with `localiser.py`. `decoding.py` and `lpo_pool.py` are the pools of worker processes that it asks, and
`heading.py` decides which heading holds. `venue_localiser.py` asks about all plans of a venue, among which
`venue_plans.py` chooses, by what `prototype_file.py` keeps. `panorama_query.py` is what all of them are asked, and
`backends.py` says what may run in other processes instead.
"""

from service.query.backends import LocaliserBackend, OptimiserBackend, VenueLocaliserBackend
from service.query.decoding import Decoder
from service.query.localiser import Localiser
from service.query.lpo_pool import LpoPool
from service.query.panorama_query import PanoramaQuery, PictureRequest, QueryContext, SequenceQuery
from service.query.venue_localiser import VenueLocaliser
from service.query.venue_plans import VenuePlans

__all__ = [
    "Decoder",
    "Localiser",
    "LocaliserBackend",
    "LpoPool",
    "OptimiserBackend",
    "PanoramaQuery",
    "PictureRequest",
    "QueryContext",
    "SequenceQuery",
    "VenueLocaliser",
    "VenueLocaliserBackend",
    "VenuePlans",
]
