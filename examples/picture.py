"""Draw the demo's picture: per panorama the photograph, and the plan with a heat map of latent distances.

The heat map needs the distance of every pose of the plan, which the service does not send; it is computed here with
the same networks. Colours are on a logarithmic scale: what matters is how much nearer the right place is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from examples.truth import FOLDER, TruePose
from lalaloc_client import Candidate, Localisation
from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.evidence import latent_distances
from lalaloc_core.panorama.images import read_panorama
from lalaloc_core.report.plan import INK, Cells, draw_camera, draw_distances, draw_plan, halo
from service.settings import Settings

_CELL_M = 0.1
_PANEL_INCHES = (12.6, 4.3)
_DPI = 110
_TRUE, _FOUND = "#ffffff", "#ff3b30"


@dataclass(frozen=True)
class Panel:
    """One panorama: the truth, and the service's answers with and without its heading."""

    truth: TruePose
    known: Localisation
    unknown: Localisation


def draw_demo(panels: Sequence[Panel], path: Path) -> None:
    """Draw all panels below one another."""
    encoders = Encoders(Bundle.open(Settings.load().bundle))
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(width, height * len(panels)), layout="constrained")
    rows = figure.subplots(len(panels), 2, width_ratios=(1.75, 1.0), squeeze=False)
    for panel, (photograph, drawing) in zip(panels, rows, strict=True):
        plan = FloorPlan.from_json((FOLDER / panel.truth.plan).read_bytes())
        _draw_photograph(photograph, panel)
        _draw_plan(figure, drawing, plan, encoders, panel)
    figure.savefig(path, dpi=_DPI, facecolor="white")


def latent_map(cells: Cells, plan: FloorPlan, encoders: Encoders, truth: TruePose) -> Float[np.ndarray, "n"]:
    """How far the panorama's latent is from that of every cell of the plan, its heading given."""
    manifest = encoders.manifest
    panorama = read_panorama(truth.picture.read_bytes(), height=manifest.image_height, width=manifest.image_width)
    query = encoders.query(panorama, heading_from_degrees(truth.heading_deg), CameraHeight(truth.camera_height_m))
    heading = np.full(len(cells.poses), query.frame_heading)
    latents, _ = encoders.poses(plan, cells.poses, heading, truth.camera_height_m)
    return latent_distances(latents, query.latents)[0]


def _draw_photograph(axes: Axes, panel: Panel) -> None:
    with Image.open(panel.truth.picture) as picture:
        axes.imshow(np.asarray(picture.convert("RGB")))
    axes.set(xticks=[], yticks=[], frame_on=False, anchor="NW")
    axes.set_title(panel.truth.file, loc="left", fontsize=12, fontweight="bold", color=INK)
    sentences = [_sentence("heading given", panel.truth, panel.known)]
    sentences.append(_sentence("heading not given", panel.truth, panel.unknown))
    # A label, not free text: the layout makes room for it.
    axes.set_xlabel("\n".join(sentences), loc="left", fontsize=10, color=INK, linespacing=1.5)


def _sentence(label: str, truth: TruePose, answer: Localisation) -> str:
    x_m, y_m = answer.position.x_m, answer.position.y_m
    error_m = math.hypot(x_m - truth.x_m, y_m - truth.y_m)
    turned = (answer.heading_deg - truth.heading_deg + 180.0) % 360.0 - 180.0
    confidence = "" if answer.confidence is None else f", confidence {answer.confidence:.2f}"
    return f"{label}: {answer.room} ({x_m:.2f}, {y_m:.2f}) m, off by {error_m:.2f} m and {turned:+.1f}°{confidence}"


def _draw_plan(figure: Figure, axes: Axes, plan: FloorPlan, encoders: Encoders, panel: Panel) -> None:
    cells = Cells.of(plan, _CELL_M)
    distance = latent_map(cells, plan, encoders, panel.truth)
    draw_distances(figure, axes, plan, cells, distance, "latent distance (log scale)")
    draw_plan(axes, plan)
    for rank, candidate in enumerate(panel.known.candidates[1:], start=2):
        _draw_candidate(axes, candidate, rank)
    truth, found = panel.truth, panel.known
    draw_camera(axes, (truth.x_m, truth.y_m), heading_from_degrees(truth.heading_deg), _TRUE, "true", 9.0)
    position = (found.position.x_m, found.position.y_m)
    draw_camera(axes, position, heading_from_degrees(found.heading_deg), _FOUND, "found", 4.5)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.01), ncols=3, frameon=False, fontsize=9, handletextpad=0.3)


def _draw_candidate(axes: Axes, candidate: Candidate, rank: int) -> None:
    x, y = candidate.position.x_m, candidate.position.y_m
    label = "other candidates" if rank == 2 else None
    ring = {"mfc": "none", "mec": "white", "markersize": 11, "mew": 1.0}
    axes.plot(x, y, "o", ls="", path_effects=halo(2.5), zorder=3, label=label, **ring)
    axes.text(x, y, str(rank), ha="center", va="center", fontsize=7.5, color="white", path_effects=halo(2.0), zorder=3)
