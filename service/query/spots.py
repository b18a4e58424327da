"""Spots: photographs of queries that were taken from one place, and the answer's part about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lalaloc_core.bundle import Manifest
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.belief import Confidence, advice_for, information_bits, union_of_arcs
from lalaloc_core.localise.localisability.reports import step_after
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.photograph import Assumed, Photograph
from lalaloc_core.photograph.cameras import Around, Fisheye
from lalaloc_core.photograph.stated_camera import intrinsics_of
from service.query.ground import Ground
from service.schemas.photographs import (
    AssumedAngle,
    CameraAnswer,
    NextStepAnswer,
    ReadView,
    SeenArc,
    SeenObjectAnswer,
    ViewAnswer,
)


@dataclass(frozen=True, eq=False)
class Spot:
    """A decoded photograph of a query, or several that were taken from one spot.

    Attributes:
        photograph: the photograph, whose heading is searched.
        others: further photographs from its place, each with its heading minus that of `photograph` (radians).
    """

    photograph: Photograph
    others: Sequence[tuple[Photograph, float]] = ()

    @property
    def arcs(self) -> list[tuple[float, float]]:
        """Azimuths (radians, first and last) that are seen, relative to the centre of `photograph`."""
        turned = [(self.photograph, 0.0), *self.others]
        return union_of_arcs([(seen.azimuths[0] + turn, seen.azimuths[1] + turn) for seen, turn in turned])


def view_answer(
    spot: Spot, ground: Ground, found: Localisation, confidence: Confidence | None, manifest: Manifest | None
) -> ViewAnswer:
    """Return the answer's part about its photograph; the next step follows from the model's `manifest`, if any."""
    bits = information_bits(ground.plan, ground.grid.poses, found.posterior.pose)
    sure = found.posterior.position if confidence is None else confidence.position
    seen, step = found.query.objects, None
    if manifest is not None:
        step = step_after(
            ground.plan,
            manifest,
            found,
            confidence,
            arcs=spot.arcs,
            field=spot.photograph.hfov.value,
            step_m=ground.grid.step_m,
            # Plans of a venue have rooms of the same names.
            rooms_known=ground.hints.rooms is not None or ground.merged is not None,
        )
    return ViewAnswer(
        **vars(read_view(spot)),
        information_bits=bits,
        ruled_out=1.0 - 2.0**-bits,
        advice=advice_for(spot.arcs, sure),
        next_step=None if step is None else NextStepAnswer(**step),
        room_types=None if seen is None else seen.room_type.shares(),
        objects=None
        if seen is None
        else [
            SeenObjectAnswer(
                name=shown.name,
                probability=shown.probability,
                azimuth_deg=math.degrees(float(wrap_angle(shown.azimuth))),
            )
            for shown in seen.objects
        ],
    )


def read_view(spot: Spot) -> ReadView:
    """Return what was assumed about a photograph."""
    photograph = spot.photograph
    return ReadView(
        projection=photograph.projection,
        projection_source=photograph.projection_source,
        hfov=_angle(photograph.hfov),
        pitch=_angle(photograph.pitch),
        roll=_angle(photograph.roll),
        wall_direction=None if photograph.wall_direction is None else _angle(photograph.wall_direction),
        camera=_camera(photograph),
        seen=[SeenArc(from_deg=math.degrees(begin), to_deg=math.degrees(end)) for begin, end in spot.arcs],
        warnings=list(photograph.warnings),
    )


def _angle(assumed: Assumed) -> AssumedAngle:
    return AssumedAngle(value_deg=math.degrees(assumed.value), std_deg=math.degrees(assumed.sd), source=assumed.source)


def _camera(photograph: Photograph) -> CameraAnswer | None:
    camera = photograph.camera
    if camera is None or isinstance(camera, Around):
        return None
    names = ("k1", "k2", "k3", "k4") if isinstance(camera, Fisheye) else ("k1", "k2", "p1", "p2", "k3")
    values = vars(intrinsics_of(camera))
    matrix = {name: values[name] for name in ("fx", "fy", "cx", "cy")}
    return CameraAnswer(width=camera.width, height=camera.height, **matrix, distortion=[values[name] for name in names])
