"""Cameras on a plan: those of several photographs, and the path of a tracked one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.draw.canvas import FOUND, INK, path, xml_text
from lalaloc_core.draw.plan import Marker, draw_camera, extent_m, plan_with
from lalaloc_core.floorplan import FloorPlan

_UNSURE = "#55606e"


@dataclass(frozen=True, eq=False)
class DrawnPath:
    """Poses of a path: positions (m), whether each is sure, and the last heading (degrees)."""

    position_m: Float[np.ndarray, "n 2"]
    is_sure: Sequence[bool]
    heading_deg: float


def draw_path(plan: FloorPlan, drawn: DrawnPath) -> str:
    """Draw a path from its first pose, a ring, to its last, the camera; unsure poses are grey."""
    extent = extent_m(plan)
    flipped = drawn.position_m * [1.0, -1.0]
    line = path([flipped], digits=3)
    dots = "".join(
        f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{extent / 220:.4f}" fill="{FOUND if is_sure else _UNSURE}"/>'
        for (x, y), is_sure in zip(flipped.tolist(), drawn.is_sure, strict=True)
    )
    x, y = flipped[0]
    start = f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{extent / 100:.4f}" fill="none" stroke="{INK}" '
    start += f'stroke-width="{extent / 500:.4f}"/>'
    over = f'<path d="{line}" fill="none" stroke="{FOUND}" stroke-width="{extent / 400:.4f}"/>{dots}{start}'
    last_x, last_y = drawn.position_m[-1]
    marker = Marker(x_m=float(last_x), y_m=float(last_y), heading_deg=drawn.heading_deg)
    return plan_with(plan, over, marker)


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
    return plan_with(plan, cameras)
