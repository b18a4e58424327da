"""Floor plans: validated, immutable rooms as closed polygons, with the openings in their walls.

Begin with `plan.py`. `reading.py` reads rooms and openings from a document, `openings.py` places openings on walls,
`checks.py` validates all rooms together, `geometry.py` builds the arrays for the layout renderer, and `anchors.py` and
`earth.py` relate a plan to latitude and longitude.
"""

from lalaloc_core.floorplan.anchors import MAX_FROM_ORIGIN_M, anchor_document
from lalaloc_core.floorplan.fixtures import FixturePlaces
from lalaloc_core.floorplan.geometry import PlanGeometry, pad_walls
from lalaloc_core.floorplan.limits import DEFAULT_LIMITS, PlanLimits
from lalaloc_core.floorplan.openings import DEFAULT_OPENING_TOLERANCE_M, USUAL_HEIGHTS_M, Opening, OpeningFace
from lalaloc_core.floorplan.plan import FloorPlan
from lalaloc_core.floorplan.reading import DEFAULT_CAMERA_HEIGHT_M, MAX_CAMERA_HEIGHT_STD_M
from lalaloc_core.floorplan.rooms import Room, room_type_from_label
