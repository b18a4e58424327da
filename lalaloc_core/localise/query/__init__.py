"""Query: an encoded photograph, and what is stated about its camera.

Begin with `query.py`. `stated_pose.py` has the height and heading that the caller, the metadata or the plan state;
`hints.py` has priors of the place.
"""

from lalaloc_core.localise.query.hints import (
    NO_HINTS,
    RADIUS_RANGE_M,
    HintName,
    Hints,
    Near,
    NearInEach,
    log_factor,
    rooms_named,
)
from lalaloc_core.localise.query.query import (
    Candidate,
    PredictedCeiling,
    PredictedOpenings,
    PredictedProfile,
    PredictedRoomType,
    Query,
    RivalWall,
    SeenObject,
    SeenObjects,
    WallDirection,
    rolled,
)
from lalaloc_core.localise.query.stated_pose import (
    DEFAULT_STD_M,
    UNKNOWN_RANGE_M,
    CameraHeight,
    KnownHeading,
    known_heading,
    stated_height,
)
