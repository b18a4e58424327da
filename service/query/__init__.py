"""What answers a panorama: decoding it, and the search with the optimiser in worker processes.

Begin with `localiser.py`. `decoding.py` and `lpo_pool.py` are the pools of worker processes that it asks, and
`heading.py` decides which heading holds. `venue_localiser.py` asks about all plans of a venue, among which
`venue_plans.py` chooses, by what `prototype_file.py` keeps. `answering.py` and `refining.py` say what others may put in
their place.
"""

from service.query.answering import Answering, VenueAnswering
from service.query.decoding import Decoder
from service.query.localiser import Localiser
from service.query.lpo_pool import LpoPool
from service.query.refining import Refining
from service.query.venue_localiser import VenueLocaliser
from service.query.venue_plans import VenuePlans

__all__ = [
    "Answering",
    "Decoder",
    "Localiser",
    "LpoPool",
    "Refining",
    "VenueAnswering",
    "VenueLocaliser",
    "VenuePlans",
]
