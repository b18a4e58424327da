"""Query: an encoded photograph, and what is stated about its camera.

Begin with `query.py`; `hints.py` has priors of the place.
"""

from lalaloc_core.localise.query.hints import NO_HINTS, HintName, Hints, Near, rooms_named
from lalaloc_core.localise.query.query import (
    DEFAULT_STD_M,
    UNKNOWN_RANGE_M,
    CameraHeight,
    Candidate,
    KnownHeading,
    PredictedCeiling,
    PredictedOpenings,
    PredictedProfile,
    PredictedRoomType,
    Query,
    SeenObject,
    SeenObjects,
    WallDirection,
    rolled,
    stated_height,
)
