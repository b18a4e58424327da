"""Right rooms of annotated photographs among twenty rooms, with and without recognised objects.

`python -m benchmarks.object_evidence --data DIR` cuts four level views from each photograph whose room has a type, and
searches each in a plan of its room among nineteen of like size and shape, heading unknown.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M
from lalaloc_core.learn.data.views import ViewPhotograph, ViewScenes
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight

_VIEWS = 4


def main() -> None:
    """Print shares of views by evidence as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of annotated photographs")
    parser.add_argument("--field", type=float, default=80.0, help="horizontal field of view (default: %(default)s)")
    parser.add_argument("--bundle", type=Path, default=default_bundle(), help="model (default: the shipped one)")
    arguments = parser.parse_args()
    model = LocalModel(Bundle.open(arguments.bundle))
    data = ViewScenes(AnnotatedPhotographs(arguments.data), arguments.field, _VIEWS)
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
    shares = {
        label: {
            "views": len(values),
            "right_room": np.mean(np.array(values) == 1),
            "among_3": np.mean(np.array(values) <= 3),
        }
        for label, values in ranks.items()
    }
    print(json.dumps(shares, indent=2))


if __name__ == "__main__":
    main()
