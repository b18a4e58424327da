"""Right types and rooms of views of spheres: what recognised objects tell.

`python -m benchmarks.object_evidence --data DIR --field 80` cuts four views from each annotated photograph whose room
has a type, and searches each in a plan of its room among nineteen of like size and shape, heading unknown, with objects
and without.

`python -m benchmarks.object_evidence --types DIR --field 70` cuts four views from each sphere of a folder whose
`types.json` names the type of each room, and counts right types; so does `--data` for its own rooms.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.conventions import ROOM_TYPES, TWO_PI
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M
from lalaloc_core.learn.data.photograph_files import FilePhotograph
from lalaloc_core.learn.data.views import CachedSphere, ViewPhotograph, ViewScenes, tilt_by_hand
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight

_VIEWS = 4
_HOME_TYPES = ("kitchen", "bedroom", "bathroom", "living")


def main() -> None:
    """Print shares of views by evidence as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of annotated photographs")
    parser.add_argument("--types", type=Path, help="folder of spheres with the types of their rooms")
    parser.add_argument("--field", type=float, default=80.0, help="horizontal field of view (default: %(default)s)")
    parser.add_argument("--bundle", type=Path, default=default_bundle(), help="model (default: the shipped one)")
    arguments = parser.parse_args()
    model = LocalModel(Bundle.open(arguments.bundle))
    results: dict[str, object] = {}
    if arguments.types is not None:
        named = json.loads((arguments.types / "types.json").read_text())
        photographs = [
            (kind, FilePhotograph(path=arguments.types / name, scene=name, room=kind))
            for name, kind in sorted(named.items())
        ]
        results["types"] = _right_types(model, photographs, arguments.field)
    if arguments.data is not None:
        data = AnnotatedPhotographs(arguments.data)
        photographs = [(each.outlines[0].room_type, each.photograph) for each in data.photographs if each.counts]
        results["types of annotated photographs"] = _right_types(model, photographs, arguments.field)
        results["rooms"] = _right_rooms(model, ViewScenes(data, arguments.field, _VIEWS))
    print(json.dumps(results, indent=2))


def _right_types(
    model: LocalModel, photographs: Iterable[tuple[str, FilePhotograph]], field_deg: float
) -> dict[str, float]:
    """Return the share of views whose most probable type is right, by type and balanced over the types of homes."""
    right: dict[str, list[bool]] = {}
    size, rng = patch_size(model.bundle.manifest), np.random.default_rng(0)
    for kind, photograph in photographs:
        if kind not in ROOM_TYPES[1:]:
            continue
        sphere = CachedSphere(photograph)
        for azimuth in TWO_PI * np.arange(_VIEWS) / _VIEWS:
            pitch, roll = tilt_by_hand(rng)
            view = ViewPhotograph(sphere=sphere, azimuth=azimuth, field_deg=field_deg, pitch=pitch, roll=roll)
            query = model.encoder.query(view.open(size), None, CameraHeight(CAMERA_HEIGHT_M))
            assert query.objects is not None
            found = int(query.objects.room_type.log_probability.argmax())
            right.setdefault(kind, []).append(ROOM_TYPES[found] == kind)
    shares = {f"{kind} ({len(values)})": float(np.mean(values)) for kind, values in sorted(right.items())}
    balanced = [np.mean(values) for kind, values in right.items() if kind in _HOME_TYPES]
    return {**shares, "balanced": float(np.mean(balanced))}


def _right_rooms(model: LocalModel, data: ViewScenes) -> dict[str, object]:
    """Return the shares of views whose room is found first and among three, by evidence."""
    ranks: dict[str, list[float]] = {"without objects": [], "with objects": []}
    for name in data.scenes("test"):
        if not name.endswith("-0"):
            continue
        scene = data.load(name)
        if scene.plan.rooms[scene.cameras[0].room_index].type == "unknown":
            continue
        grid = model.grid(scene.plan, CAMERA_HEIGHT_M)
        for camera in scene.cameras:
            (photograph,) = camera.photographs.values()
            assert isinstance(photograph, ViewPhotograph)
            view = photograph.open(patch_size(model.bundle.manifest))
            query = model.encoder.query(view, None, CameraHeight(CAMERA_HEIGHT_M))
            for label, asked in zip(ranks, (dataclasses.replace(query, objects=None), query), strict=True):
                found = model.localise(scene.plan, grid, asked).candidates
                rooms = list(dict.fromkeys(candidate.room_index for candidate in found))
                ranks[label].append(1 + rooms.index(camera.room_index) if camera.room_index in rooms else np.inf)
    return {
        label: {
            "views": len(values),
            "right_room": np.mean(np.array(values) == 1),
            "among_3": np.mean(np.array(values) <= 3),
        }
        for label, values in ranks.items()
    }


if __name__ == "__main__":
    main()
