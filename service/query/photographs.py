"""Photographs of queries: from decoded files to encoded queries, and to the answer's part about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Confidence, advice_for, information_bits, union_of_arcs
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, KnownHeading, Query
from lalaloc_core.localise.search.pipeline import Localisation, StageClock
from lalaloc_core.photograph import Assumed, Photograph
from lalaloc_core.photograph.cameras import Around, Fisheye
from lalaloc_core.photograph.stated_camera import intrinsics_of
from service.schemas.photographs import AssumedAngle, CameraAnswer, ReadView, SeenArc, ViewAnswer


@dataclass(frozen=True, eq=False)
class Spot:
    """A decoded photograph of a query, or several that were taken from one spot.

    Attributes:
        view: the photograph, whose heading is searched.
        others: further photographs from its place, each with its heading minus that of `view` (radians).
    """

    view: Photograph
    others: Sequence[tuple[Photograph, float]] = ()

    @property
    def arcs(self) -> list[tuple[float, float]]:
        """Azimuths (radians, first and last) that are seen, relative to the centre of `view`."""
        turned = [(self.view, 0.0), *self.others]
        return union_of_arcs([(view.azimuths[0] + turn, view.azimuths[1] + turn) for view, turn in turned])


def encode(
    encoder: PhotographEncoder,
    spots: Sequence[Spot],
    known: Sequence[KnownHeading],
    height: CameraHeight,
    clock: StageClock,
) -> list[Query]:
    """Encode decoded photographs, each with its known heading; all queries go through here.

    Raises:
        InvalidPhotographError: a photograph is no sphere, and the model has no encoder of views.
    """
    with clock.stage("encode"):
        return [
            encoder.query(
                spot.view,
                heading.heading,
                height,
                heading_tolerance=heading.tolerance,
                others=spot.others,
            )
            for spot, heading in zip(spots, known, strict=True)
        ]


def view_answer(
    spot: Spot, found: Localisation, confidence: Confidence | None, plan: FloorPlan, grid: PoseGrid
) -> ViewAnswer:
    """Return the answer's part about its photograph; `plan` and `grid` are those that were searched."""
    bits = information_bits(plan, grid.poses, found.posterior.pose)
    sure = found.posterior.position if confidence is None else confidence.position
    return ViewAnswer(
        **vars(read_view(spot)),
        information_bits=bits,
        ruled_out=1.0 - 2.0**-bits,
        advice=advice_for(spot.arcs, sure),
    )


def read_view(spot: Spot) -> ReadView:
    """Return what was assumed about a photograph."""
    view = spot.view
    return ReadView(
        projection=view.projection,
        projection_source=view.projection_source,
        hfov=_angle(view.hfov),
        pitch=_angle(view.pitch),
        roll=_angle(view.roll),
        camera=_camera(view),
        seen=[SeenArc(from_deg=math.degrees(begin), to_deg=math.degrees(end)) for begin, end in spot.arcs],
        warnings=list(view.warnings),
    )


def _angle(assumed: Assumed) -> AssumedAngle:
    return AssumedAngle(value_deg=math.degrees(assumed.value), std_deg=math.degrees(assumed.sd), source=assumed.source)


def _camera(view: Photograph) -> CameraAnswer | None:
    camera = view.camera
    if camera is None or isinstance(camera, Around):
        return None
    names = ("k1", "k2", "k3", "k4") if isinstance(camera, Fisheye) else ("k1", "k2", "p1", "p2", "k3")
    values = vars(intrinsics_of(camera))
    matrix = {name: values[name] for name in ("fx", "fy", "cx", "cy")}
    return CameraAnswer(width=camera.width, height=camera.height, **matrix, distortion=[values[name] for name in names])
