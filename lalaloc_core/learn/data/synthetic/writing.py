"""Generated scenes on disk in Structured3D's layout: `lalaloc lab synth`.

A scene gets its final name when it is complete, so an interrupted run can continue. A scene depends on its number and
the settings only, not on the run or the process that renders it.
"""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
import os
import re
import shutil
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Literal

import torch
from tqdm import tqdm

from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.files import PART_SUFFIX, atomic_write
from lalaloc_core.learn.data.structured3d import (
    RENDERING_FOLDER,
    SYNTHETIC_FILE,
    Structured3D,
    Synthetic,
    scene_name,
    scene_numbers,
)
from lalaloc_core.learn.data.structured3d_writer import write_annotation, write_camera, write_depth, write_picture
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.dataset_names import SPLITS, Split
from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.lighting import MOODS
from lalaloc_core.learn.synth.scene.materials import CATEGORIES
from lalaloc_core.learn.synth.scene.shots import Shot, stage_rooms

PICTURES_PER_ROOM = len(FURNITURE_LEVELS) * len(MOODS)
_MIN_HEIGHT, _MAX_HEIGHT = 16, 4096
_SCENE = re.compile(r"scene_\d+")


@dataclass(frozen=True, kw_only=True)
class Synthesis:
    """Settings of generated scenes on disk.

    Spheres are twice as wide as their `height`, which is even. With `textures` None all materials are procedural.
    """

    root: Path
    seed: int = 0
    height: int = 256
    textures: Path | None = None

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InvalidInputError(f"seed is {self.seed}; the minimum is 0")
        if self.height % 2 or not _MIN_HEIGHT <= self.height <= _MAX_HEIGHT:
            raise InvalidInputError(
                f"height is {self.height}; it must be an even number from {_MIN_HEIGHT} to {_MAX_HEIGHT}"
            )
        folder = self.textures
        if folder is not None and not any(any((folder / kind).glob("*/*.jpg")) for kind in CATEGORIES):
            raise InvalidInputError(f"no <category>/<material>/*.jpg below '{folder}' (--textures)")

    @property
    def marker(self) -> Synthetic:
        """Content of the data set's `synthetic.json`."""
        name = None if self.textures is None else self.textures.resolve().name
        return Synthetic(format=1, seed=self.seed, height=self.height, width=2 * self.height, textures=name)


def share_out(scenes: int, split: Split | Literal["all"]) -> dict[Split, tuple[int, ...]]:
    """Choose the numbers of the scenes to write by split: each split's first ones that the paper does not exclude.

    "all" divides them like the official splits; each then gets at least one of three or more scenes.
    """
    numbers: dict[Split, tuple[int, ...]] = {name: scene_numbers(name) for name in SPLITS if split in ("all", name)}
    total = sum(len(available) for available in numbers.values())
    if not 1 <= scenes <= total:
        where = "the splits" if split == "all" else f"split '{split}'"
        raise InvalidInputError(f"scenes is {scenes}; the limits of {where} are 1 to {total}")
    exact = {name: scenes * len(available) / total for name, available in numbers.items()}
    counts = {name: math.floor(share) for name, share in exact.items()}
    by_remainder = sorted(exact, key=lambda name: counts[name] - exact[name])
    for name in by_remainder[: scenes - sum(counts.values())]:
        counts[name] += 1
    for name in numbers:
        if counts[name] == 0 and scenes >= len(numbers):
            counts[name] = 1
            counts[max(counts, key=lambda largest: counts[largest])] -= 1
    return {name: available[: counts[name]] for name, available in numbers.items()}


def synthesise(settings: Synthesis, numbers: dict[Split, tuple[int, ...]], *, workers: int = 1) -> int:
    """Write the missing scenes of these numbers and return how many; one worker renders in this process."""
    if workers < 1:
        raise InvalidInputError(f"workers is {workers}; the minimum is 1")
    wanted = [_Job(settings, split, number) for split, chosen in numbers.items() for number in chosen]
    with _write_errors(settings.root):
        _claim(settings)
        for job in wanted:
            shutil.rmtree(job.part, ignore_errors=True)
        missing = [job for job in wanted if not job.folder.is_dir()]
    with (
        closing(_write_serially(missing) if workers == 1 else _write_in_processes(workers, missing)) as finished,
        tqdm(total=len(wanted), initial=len(wanted) - len(missing), desc="synth", unit="scene") as bar,
    ):
        spheres = 0
        for count in finished:
            spheres += count
            bar.set_postfix_str(f"{spheres / bar.format_dict['elapsed']:.1f} spheres/s", refresh=False)
            bar.update()
    return len(missing)


@dataclass(frozen=True)
class _Job:
    """A scene to write."""

    settings: Synthesis
    split: Split
    number: int

    @property
    def folder(self) -> Path:
        return self.settings.root / scene_name(self.number)

    @property
    def part(self) -> Path:
        return self.settings.root / (scene_name(self.number) + PART_SUFFIX)


# Set when a worker process starts, because an event can be passed at no other time.
_stop: Event | None = None


def _write_scene(job: _Job) -> int:
    """Render and write one scene, and return its number of spheres; a failure, or `_stop`, leaves no files."""
    settings, split = job.settings, SPLIT_NUMBERS[job.split]
    home, rng = home_of(split, settings.seed, job.number)
    renderer = split_renderer_cache(split, settings.seed, settings.textures).renderer(
        settings.height, 2 * settings.height
    )
    shots = stage_rooms(home, rng)
    try:
        with _write_errors(job.part):
            job.part.mkdir()
            write_annotation(job.part, home.plan, home.openings)
            for shot in shots:
                if _stop is not None and _stop.is_set():
                    return 0
                _write_room(job.part / RENDERING_FOLDER / str(shot.room_index) / "panorama", shot, renderer)
            job.part.rename(job.folder)
    finally:
        # No effect after the rename.
        shutil.rmtree(job.part, ignore_errors=True)
    return PICTURES_PER_ROOM * len(shots)


def _write_room(folder: Path, shot: Shot, renderer: SphereRenderer) -> None:
    folder.mkdir(parents=True)
    write_camera(folder, shot.home.plan.rooms[shot.room_index], shot.position_m, shot.camera_height_m)
    for furniture in FURNITURE_LEVELS:
        pictures, depth_m = renderer.render_moods(dataclasses.replace(shot, furniture=furniture), MOODS)
        (folder / furniture).mkdir()
        for mood, pixels in zip(MOODS, pictures.numpy(), strict=True):
            write_picture(folder / furniture / f"rgb_{mood}light.png", pixels)
        write_depth(folder / furniture / "depth.png", depth_m.numpy())


def _claim(settings: Synthesis) -> None:
    """Mark a new folder with the settings, or check that an existing one has the same settings."""
    root, marker = settings.root, settings.marker
    path = root / SYNTHETIC_FILE
    root.mkdir(parents=True, exist_ok=True)
    found = Structured3D(root).synthetic
    if found is None:
        foreign = next((entry.name for entry in root.iterdir() if _SCENE.fullmatch(entry.name)), None)
        if foreign is not None:
            raise DatasetError(
                f"holds '{foreign}' but no {SYNTHETIC_FILE}: its scenes are not generated; choose another folder",
                path=root,
            )
        atomic_write(path, json.dumps(dataclasses.asdict(marker)) + "\n")
    elif found != marker:
        before, now = dataclasses.asdict(found), dataclasses.asdict(marker)
        differences = [f"{key} {before[key]!r}, not {now[key]!r}" for key in before if before[key] != now[key]]
        raise DatasetError(f"its scenes were generated with {'; '.join(differences)}", path=root)


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Convert a full disk or a read-only folder to a DatasetError."""
    try:
        yield
    except OSError as error:
        where = Path(error.filename) if isinstance(error.filename, str) else path
        raise DatasetError(f"cannot be written: {error.strerror or error}", path=where) from error


def _write_serially(jobs: Sequence[_Job]) -> Generator[int]:
    """Write scenes in this process and yield their numbers of spheres."""
    threads = torch.get_num_threads()
    # As in worker processes, because the number of threads changes the last bit of sums.
    torch.set_num_threads(1)
    try:
        yield from map(_write_scene, jobs)
    finally:
        torch.set_num_threads(threads)


def _write_in_processes(workers: int, jobs: Sequence[_Job]) -> Generator[int]:
    """Write scenes in worker processes and yield their numbers of spheres in order."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    pool = ProcessPoolExecutor(workers, context, _start_worker, (stop,))
    try:
        yield from pool.map(_write_scene, jobs)
    except BrokenProcessPool as error:
        raise DatasetError(
            "a worker process died; use fewer --workers if memory is short", path=jobs[0].settings.root
        ) from error
    finally:
        # After an interruption or an error the workers abandon their scenes.
        stop.set()
        pool.shutdown(cancel_futures=True)


def _start_worker(stop: Event) -> None:
    global _stop
    _stop = stop
    torch.set_num_threads(1)
    # Ctrl-C reaches the whole process group; the parent stops its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
