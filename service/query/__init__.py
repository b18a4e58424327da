"""What answers a panorama: decoding it, and the search with the optimiser in worker processes.

Begin with `localiser.py`. `decoding.py` and `lpo_pool.py` are the pools of worker processes that it asks, and
`heading.py` decides which heading holds.
"""

from service.query.decoding import Decoder
from service.query.localiser import Localiser
from service.query.lpo_pool import LpoPool

__all__ = ["Decoder", "Localiser", "LpoPool"]
