"""`make demo`: localise the example photographs over HTTP and draw the results to demo.png.

The demo starts the service on a free port with a temporary data folder, uploads the example flat, and localises each
photograph with and without its heading. It prints the results beside the true poses, draws them, and stops the service.
The exit status is 0 if every stage ran.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from examples.launch import ROOT, ServiceFailedError, running_service
from examples.truth import PLAN_PATH, TruePose, read_poses
from lalaloc_client import Client, ClientError, Localisation, QueryOptions
from lalaloc_core.draw.canvas import MUTED, document, image, pixels, words
from lalaloc_core.shown_text import probability_text

_PLAN_TIMEOUT_S = 120.0
# Long timeouts prevent a fallback to a coarser stage on a busy machine. Messages of the log would interrupt the table,
# and that a new database is empty is no news here.
_DEFAULTS = {"LALALOC_LPO_DEADLINE_S": "30", "LALALOC_REQUEST_DEADLINE_S": "60", "LALALOC_LOG_LEVEL": "error"}

# Size of a panel: width of its picture, height of its heading, and gap between panels.
_WIDTH, _HEAD, _GAP = 1000, 96, 30
_COLUMNS = 2
_JPEG_QUALITY = 88


@dataclass(frozen=True)
class Panel:
    """Results for one photograph with and without its heading; `picture` is the PNG of `known`."""

    truth: TruePose
    known: Localisation
    unknown: Localisation
    picture: bytes
    size: tuple[int, int]


class StageMissingError(Exception):
    """A stage did not run; the message names it."""


def main() -> int:
    """Run the demo and return 0 if every stage ran, else 1."""
    parser = argparse.ArgumentParser(prog="python -m examples.demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "demo.png", help="the picture, PNG or JPEG")
    out: Path = parser.parse_args().out
    try:
        panels = localise_examples()
        draw_demo(panels, out)
    except (StageMissingError, ServiceFailedError, ClientError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    print(f"\nwrote {out}: the layout over every photograph, and the probability of poses on the plan")
    return 0


def localise_examples() -> list[Panel]:
    """Localise every example photograph with a new service, and print a line per result.

    Raises:
        ClientError: the plan did not become ready, or a request failed.
        StageMissingError: a localisation is incomplete.
    """
    with tempfile.TemporaryDirectory(prefix="lalaloc-demo-") as data:
        given = {name: os.environ[name] for name in _DEFAULTS if name in os.environ}
        environment = _DEFAULTS | given | {"LALALOC_DATA_DIR": data}
        print("starting the service ...", flush=True)
        with running_service(0, environment) as service, Client(service.url) as client:
            plan_id = prepare_plan(client)
            print(_HEADER, flush=True)
            return [_localise_photograph(client, plan_id, truth) for truth in read_poses()]


def prepare_plan(client: Client) -> str:
    """Upload the example flat, wait for its pose grid, and return the plan's id."""
    plan = client.wait_until_ready(client.upload_floorplan(PLAN_PATH).id, timeout_s=_PLAN_TIMEOUT_S)
    print(
        f"plan '{plan.name}' is ready: {len(plan.rooms)} rooms, {plan.area_m2:.1f} m², "
        f"{plan.grid.poses} poses every {plan.grid.step_m:g} m\n"
    )
    return plan.id


def _localise_photograph(client: Client, plan_id: str, truth: TruePose) -> Panel:
    stated = QueryOptions(heading_deg=truth.heading_deg, camera_height_m=truth.camera_height_m)
    known = client.localise(plan_id, truth.picture, **stated)
    unknown = client.localise(plan_id, truth.picture, camera_height_m=truth.camera_height_m)
    for label, localisation in (("known", known), ("unknown", unknown)):
        check_localisation(localisation)
        print(_line(truth, label, localisation), flush=True)
    picture = client.picture(plan_id, truth.picture, **stated)
    with Image.open(io.BytesIO(picture)) as opened:
        return Panel(truth, known, unknown, picture, opened.size)


def check_localisation(localisation: Localisation) -> None:
    """Check that a localisation passed every stage and contains only finite numbers."""
    if localisation.stage != "lpo":
        raise StageMissingError(f"the localisation ends at stage '{localisation.stage}', not at 'lpo'")
    if not localisation.candidates:
        raise StageMissingError("the localisation has no candidates")
    broken = [path for path, value in _numbers(dataclasses.asdict(localisation)) if not math.isfinite(value)]
    if broken:
        raise StageMissingError(f"the localisation has numbers that are not finite: {', '.join(broken)}")


def _numbers(value: Any, path: str = "localisation") -> Iterator[tuple[str, float]]:
    """Yield every number in nested values with its path."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _numbers(inner, f"{path}[{index}]")
    elif isinstance(value, int | float):
        yield path, float(value)


_HEADER = (
    f"{'photograph':<16} {'heading':<8} {'true x, y':>12} {'found x, y':>12} {'error_m':>8} {'heading_deg':>12} "
    f"{'confidence':>10} {'room':<12} {'ms':>6}"
)


def _line(truth: TruePose, label: str, localisation: Localisation) -> str:
    x_m, y_m = localisation.position.x_m, localisation.position.y_m
    error_m = math.hypot(x_m - truth.x_m, y_m - truth.y_m)
    confidence = "-" if localisation.confidence is None else probability_text(localisation.confidence)
    return (
        f"{truth.file:<16} {label:<8} {f'{truth.x_m:.2f}, {truth.y_m:.2f}':>12} {f'{x_m:.2f}, {y_m:.2f}':>12} "
        f"{error_m:>8.3f} {localisation.heading_deg:>12.1f} {confidence:>10} {localisation.room:<12} "
        f"{localisation.timings_ms['total']:>6.0f}"
    )


def draw_demo(panels: Sequence[Panel], path: Path) -> None:
    """Draw all panels in two columns."""
    height = max(_WIDTH * panel.size[1] / panel.size[0] for panel in panels)
    row_height, rows = _HEAD + height + _GAP, -(-len(panels) // _COLUMNS)
    parts = []
    for index, panel in enumerate(panels):
        row, column = divmod(index, _COLUMNS)
        parts.append(_panel(panel, _GAP + column * (_WIDTH + _GAP), row * row_height))
    whole = document(_COLUMNS * (_WIDTH + _GAP) + _GAP, rows * row_height, "LaLaLoc", parts)
    drawn: Image.Image = pixels(whole)
    # PNG ignores the quality.
    drawn.save(path, quality=_JPEG_QUALITY)


def _panel(panel: Panel, x: float, y: float) -> str:
    box = (x, y + _HEAD, _WIDTH, _WIDTH * panel.size[1] / panel.size[0])
    sentences = (
        _sentence("heading given", panel.truth, panel.known),
        _sentence("heading not given", panel.truth, panel.unknown),
    )
    return "".join(
        [
            words(x + 24, y + 40, panel.truth.file, 26, more='font-weight="bold"'),
            *(words(x + 24, y + 68 + 24 * line, text, 17, fill=MUTED) for line, text in enumerate(sentences)),
            image(panel.picture, "png", box, 'image-rendering="smooth"'),
        ]
    )


def _sentence(label: str, truth: TruePose, localisation: Localisation) -> str:
    x_m, y_m = localisation.position.x_m, localisation.position.y_m
    error_m = math.hypot(x_m - truth.x_m, y_m - truth.y_m)
    turn_deg = (localisation.heading_deg - truth.heading_deg + 180.0) % 360.0 - 180.0
    confidence = "" if localisation.confidence is None else f", confidence {probability_text(localisation.confidence)}"
    return (
        f"{label}: {localisation.room} ({x_m:.2f}, {y_m:.2f}) m, error {error_m:.2f} m and {turn_deg:+.1f}°{confidence}"
    )


if __name__ == "__main__":
    sys.exit(main())
