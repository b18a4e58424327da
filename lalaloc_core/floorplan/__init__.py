"""Floor plans: validated, immutable rooms as closed polygons, with the openings in their walls.

Begin with `plan.py`. `plan_document.py` reads rooms and openings from a document, `room_types.py` knows the names of
rooms, `plan_words.py` the other words of plans, `openings.py` places openings on walls, `opening_trust.py` tells how
many are missing, `rooms.py` checks all rooms together, `geometry.py` builds the arrays for the layout renderer, and
`earth.py` relates a plan to latitude and longitude.
"""

from lalaloc_core.floorplan.json_values import DEFAULT_LIMITS, PlanLimits
from lalaloc_core.floorplan.openings import DEFAULT_OPENING_TOLERANCE_M, USUAL_HEIGHTS_M, OpeningFace
from lalaloc_core.floorplan.plan import FloorPlan
from lalaloc_core.floorplan.plan_document import DEFAULT_CAMERA_HEIGHT_M, MAX_CAMERA_HEIGHT_STD_M, FixturePlaces
from lalaloc_core.floorplan.room_types import room_type_from_label
from lalaloc_core.floorplan.rooms import Room
