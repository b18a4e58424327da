"""What the segmenter that teaches on photographs sees in renderings, and in annotated photographs.

Where it agrees with the truth, is there anything that the model has not learnt yet? And do renderings look to it as
photographs do, in which it sees doors, windows and the ends of floors nearly everywhere?

    .venv/bin/python -m scripts.what_a_teacher_sees TEACHER.tflite --homes 20 --textures textures --photographs ROOT
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.evaluate.runs.photograph_reading import read_azimuths
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, is_annotation, read_annotation
from lalaloc_core.learn.data.dataset import Photograph
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.training.segmenter import PANORAMA_ROWS, Segment, load_segmenter, read_walls_and_openings
from lalaloc_core.localise.bundle import Bundle, default_bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.render.layout import layout_view

_WALL, _DOOR, _WINDOW, _PASSAGE = (OPENING_CLASSES.index(name) for name in ("wall", "door", "window", "passage"))
# A line of the teacher's agrees with the truth within this error of log distance.
_AGREES = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class Asked:
    """A panorama and the truth about it: class and log distance (m) at each azimuth."""

    photograph: Photograph
    camera_height_m: float
    kind: Int[np.ndarray, "w"]
    log_m: Float[np.ndarray, "w"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What teacher and model see at the azimuths of all panoramas; the teacher tells no passage from a wall."""

    kind: Int[np.ndarray, "n"]
    log_m: Float[np.ndarray, "n"]
    teacher_kind: Int[np.ndarray, "n"]
    teacher_log_m: Float[np.ndarray, "n"]
    model_kind: Int[np.ndarray, "n"]
    model_log_m: Float[np.ndarray, "n"]


def main() -> None:
    """Print a table for each kind of picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("teacher", type=Path, help="the segmenter, a TensorFlow Lite file")
    parser.add_argument("--bundle", type=Path, default=default_bundle())
    parser.add_argument("--homes", type=int, default=20, help="validation homes, 4 furnished panoramas each")
    parser.add_argument("--textures", type=Path)
    parser.add_argument("--photographs", type=Path, help="folder of annotated photographs")
    asked = parser.parse_args()
    segment, encoders = load_segmenter(asked.teacher), Encoders(Bundle.open(asked.bundle), threads=1)
    columns = encoders.manifest.profile_columns
    homes = GeneratedScenes(homes=asked.homes, textures=asked.textures)
    print_table("renderings", look(_rendered(homes, columns), segment, encoders))
    if asked.photographs is not None:
        print_table("photographs", look(_annotated(asked.photographs, columns), segment, encoders))


def _rendered(homes: GeneratedScenes, columns: int) -> Iterator[Asked]:
    for name in homes.scenes("validation"):
        scene = homes.load(name)
        for camera in scene.cameras:
            heading, room = np.array([camera.heading]), np.array([camera.room_index])
            view = layout_view(
                camera.position_m[None], heading, room, scene.plan.geometry, columns, camera.camera_height_m
            )
            (photograph,) = camera.photographs.values()
            yield Asked(
                photograph=photograph,
                camera_height_m=camera.camera_height_m,
                kind=view.kind[0],
                log_m=np.log(view.distance_m[0]),
            )


def _annotated(folder: Path, columns: int) -> Iterator[Asked]:
    for path in sorted(folder.glob("*.json")):
        if is_annotation(path) and (one := read_annotation(path)).counts:
            yield Asked(
                photograph=one.photograph,
                camera_height_m=CAMERA_HEIGHT_M,
                kind=one.classes(columns),
                log_m=np.log(one.profile_m(0, columns)),
            )


def look(pictures: Iterator[Asked], segment: Segment, encoders: Encoders) -> Seen:
    """Let the teacher and the model look at each picture, each at its own resolution."""
    rows = []
    for one in pictures:
        columns = len(one.kind)
        log_m, _, scores = read_azimuths(encoders, _image(one, encoders.manifest.image_height), one.camera_height_m)
        if scores is None:
            raise SystemExit(f"the model '{encoders.manifest.name}' tells no openings")
        reading = read_walls_and_openings(_image(one, PANORAMA_ROWS), segment, columns)
        door, window = reading.openings.T
        told = np.where(door > 0.5, _DOOR, np.where(window > 0.5, _WINDOW, _WALL))
        told_m = reading.log_distance + np.log(one.camera_height_m)
        rows.append((one.kind, one.log_m, told, told_m, scores.argmax(axis=1), log_m))
    kind, true_m, told, told_m, model_kind, model_m = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Seen(
        kind=kind,
        log_m=true_m,
        teacher_kind=told,
        teacher_log_m=told_m,
        model_kind=model_kind,
        model_log_m=model_m,
    )


def _image(one: Asked, rows: int) -> UInt8[np.ndarray, "h w 3"]:
    return one.photograph.image(rows, 2 * rows)


def print_table(title: str, seen: Seen) -> None:
    """One row for each class and one for the walls' distances."""
    print(f"\n{title}, {len(seen.kind):,} azimuths\n")
    print("| | teacher sees | model right where it does | elsewhere |\n|---|---|---|---|")
    for code, name in enumerate(OPENING_CLASSES):
        here = seen.kind == code
        agrees = here & (seen.teacher_kind == (_WALL if code == _PASSAGE else code))
        right = seen.model_kind == code
        print(f"| {name} | {_share(agrees, here)} | {_share(right, agrees)} | {_share(right, here & ~agrees)} |")
    error, model = np.abs(seen.teacher_log_m - seen.log_m), np.abs(seen.model_log_m - seen.log_m)
    known, close = np.isfinite(error), np.nan_to_num(error, nan=np.inf) < _AGREES
    print(f"| walls' distance within {_AGREES} | {_share(close, close | ~close)} | | |")
    print(f"| median error of log distance | {_median(error[known])} at {_share(known, close | ~close)} | ", end="")
    print(f"{_median(model[close])} | {_median(model[~close])} |")


def _share(of: np.ndarray, among: np.ndarray) -> str:
    return f"{100.0 * np.mean(of[among]):.0f} %" if among.any() else "none"


def _median(error: np.ndarray) -> str:
    return f"{np.median(error):.3f}" if len(error) else "none"


if __name__ == "__main__":
    main()
