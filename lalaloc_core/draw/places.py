"""Cameras of several photographs, drawn on one plan."""

from __future__ import annotations

from collections.abc import Sequence

from lalaloc_core.draw.canvas import INK, xml_text
from lalaloc_core.draw.plan import HEAT_PLACE, Marker, draw_camera, draw_rooms, extent_m, svg_around
from lalaloc_core.floorplan import FloorPlan


def draw_places(plan: FloorPlan, places: Sequence[tuple[str, Marker]]) -> str:
    """Draw a plan with a camera, labelled with its text, for each place."""
    extent = extent_m(plan)
    size = extent / 60
    cameras = "".join(
        f"{draw_camera(marker, extent)}"
        f'<text x="{marker.x_m:.3f}" y="{size * 1.8 - marker.y_m:.3f}" font-size="{size:.3f}" fill="{INK}" '
        f'stroke="#fff" stroke-width="{size / 5:.4f}" paint-order="stroke">{xml_text(text)}</text>'
        for text, marker in places
    )
    head, tail = svg_around(plan.name, plan.bounds_m)
    return head + draw_rooms(plan).replace(HEAT_PLACE, "") + cameras + tail
