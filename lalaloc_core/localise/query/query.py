"""Encoded photograph as searches compare it, and the poses that they find for it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from lalaloc_core.localise.query.predictions import (
    PredictedCeiling,
    PredictedOpenings,
    PredictedProfile,
    PredictedRoomType,
    SeenObjects,
    WallDirection,
)
from lalaloc_core.localise.query.stated_pose import CameraHeight


@dataclass(frozen=True, eq=False)
class Query:
    """An encoded photograph, with one latent per hypothesis of the heading.

    A photograph is compared in its *frame*: rolled by whole pixels or ring sectors so that its centre column looks
    (almost) along azimuth 0. Hypothesis k assumes a photograph heading of `roll[k] + frame_heading`, and its latent is
    compared with layouts rendered at `frame_heading`.

    Attributes:
        latents: (k, d), L2-normalised.
        roll: (k,) angle (radians) that was rolled away.
        frame_heading: rest (radians) that rolling by whole pixels leaves; 0 if the heading is unknown.
        heading_known: whether the heading was given exactly; otherwise it is searched and refined.
        camera_height: stated camera height, which predictions in metres refer to.
        profile: predicted wall profile; None if the image encoder predicts none.
        openings, ceiling, room_type: other predictions; None if the image encoder does not make them.
        objects: recognised objects, whose room type replaces `room_type`; None if the model recognises none.
        wall_directions: directions of walls that the lines of each photograph tell.
        searched: the same photograph with an unknown heading, to doubt a given one; None if the heading is unknown.
        is_view: whether the encoder of views read it, which has matching weights and confidence of its own.
        is_turn: whether it is several views from one spot, which have a confidence of their own.
    """

    latents: Float[np.ndarray, "k d"]
    roll: Float[np.ndarray, "k"]
    frame_heading: float
    heading_known: bool
    camera_height: CameraHeight
    profile: PredictedProfile | None = None
    openings: PredictedOpenings | None = None
    ceiling: PredictedCeiling | None = None
    room_type: PredictedRoomType | None = None
    objects: SeenObjects | None = None
    wall_directions: tuple[WallDirection, ...] = ()
    searched: Query | None = None
    is_view: bool = False
    is_turn: bool = False

    def scaled(self, offset: float) -> Query:
        """Return the query if the camera stood higher by the factor `exp(offset)`."""
        profile, ceiling = self.profile, self.ceiling
        return replace(
            self,
            profile=None if profile is None else profile.scaled(offset),
            ceiling=None if ceiling is None else replace(ceiling, log_m=ceiling.log_m + offset),
        )

    @property
    def sector(self) -> float:
        """Angle (radians) between neighbouring hypotheses; 0 for a single one."""
        return float(self.roll[1] - self.roll[0]) if len(self.roll) > 1 else 0.0


@dataclass(frozen=True)
class Candidate:
    """A pose and its cost.

    Attributes:
        frame_heading: heading (radians) of the layout in the frame of the hypothesis; the photograph's heading is
            `query.roll[hypothesis] + frame_heading`.
        cost: matching cost; the latent distance if the model predicts no wall profile.
        latent_distance: distance of the layout's latent to the query's; NaN until computed, as it is for answers.
        height_offset: log of true over stated camera height that fits best.
        place_cost: cost of hints, fixtures and directions of walls at the pose, in units of the cost; see
            `localise.match.place_cost`.
        terms: terms of the matching cost by name; empty if poses are compared by latents.
        information: (p, p) curvature of the cost by x, y (m) and, if it was searched, the heading (radians), from pose
            refinement. Its inverse is the covariance up to a factor.
    """

    x_m: float
    y_m: float
    room_index: int
    frame_heading: float
    hypothesis: int
    cost: float
    latent_distance: float
    height_offset: float = 0.0
    place_cost: float = 0.0
    terms: dict[str, float] = field(default_factory=dict, compare=False)
    information: Float[np.ndarray, "p p"] | None = field(default=None, compare=False)

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])

    @property
    def total_cost(self) -> float:
        """Cost that candidates are ranked by: the matching cost plus that of the place."""
        return self.cost + self.place_cost
