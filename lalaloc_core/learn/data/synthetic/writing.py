"""Synthetic scenes on disk, in Structured3D's layout: `lalaloc synth`.

A scene appears under its own name only when it is complete, so an interrupted run goes on where it stopped. What a
scene looks like depends on its number and the settings alone, not on the run or the process that renders it.
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
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
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
from lalaloc_core.learn.data.dataset import SPLITS, Split
from lalaloc_core.learn.data.structured3d import RENDERING_FOLDER, SYNTHETIC_FILE, Structured3D, Synthetic, scene_name
from lalaloc_core.learn.data.structured3d_splits import scene_numbers
from lalaloc_core.learn.data.structured3d_writer import (
    room_id,
    write_annotation,
    write_camera,
    write_depth,
    write_picture,
)
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, renderer_cache_of
from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS
from lalaloc_core.learn.synth.homes.splits import home_of
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer
from lalaloc_core.learn.synth.scene.lighting import MOODS
from lalaloc_core.learn.synth.scene.materials import CATEGORIES
from lalaloc_core.learn.synth.scene.shots import Shot, stage_rooms

PICTURES_PER_ROOM = len(FURNITURE_LEVELS) * len(MOODS)
_MIN_HEIGHT, _MAX_HEIGHT = 16, 4096
_SCENE = re.compile(r"scene_\d+")


@dataclass(frozen=True, kw_only=True)
class Synthesis:
    """What decides how scenes look, and where they are written.

    Attributes:
        root: folder of the data set.
        seed: of the homes and everything in them.
        height: rows of a panorama, even; it is twice as wide.
        textures: folder of material pictures; without it all are procedural.
    """

    root: Path
    seed: int = 0
    height: int = 256
    textures: Path | None = None

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InvalidInputError(f"the seed is {self.seed}, it must not be negative")
        if self.height % 2 or not _MIN_HEIGHT <= self.height <= _MAX_HEIGHT:
            raise InvalidInputError(
                f"panoramas of {self.height} rows, an even number from {_MIN_HEIGHT} to {_MAX_HEIGHT} is needed"
            )
        folder = self.textures
        if folder is not None and not any(any((folder / kind).glob("*/*.jpg")) for kind in CATEGORIES):
            raise InvalidInputError(f"no <category>/<material>/*.jpg below '{folder}'")

    @property
    def marker(self) -> Synthetic:
        """What the data set says of itself."""
        name = None if self.textures is None else self.textures.resolve().name
        return Synthetic(format=1, seed=self.seed, height=self.height, width=2 * self.height, textures=name)


def share_out(scenes: int, split: Split | Literal["all"]) -> dict[Split, tuple[int, ...]]:
    """Numbers of the scenes to write, by split: each split's first ones that the paper does not exclude.

    Args:
        scenes: how many.
        split: which split, or "all": then shared out like the official ones, and from three on each has some.

    Raises:
        InvalidInputError: more scenes than there are numbers, or none.
    """
    numbers: dict[Split, tuple[int, ...]] = {one: scene_numbers(one) for one in SPLITS if split in ("all", one)}
    total = sum(len(found) for found in numbers.values())
    if not 1 <= scenes <= total:
        where = "the splits have" if split == "all" else f"split '{split}' has"
        raise InvalidInputError(f"{scenes} scenes asked for, from 1 to {total} are possible: that many numbers {where}")
    exact = {one: scenes * len(found) / total for one, found in numbers.items()}
    counts = {one: math.floor(share) for one, share in exact.items()}
    by_remainder = sorted(exact, key=lambda one: counts[one] - exact[one])
    for one in by_remainder[: scenes - sum(counts.values())]:
        counts[one] += 1
    for one in numbers:
        if counts[one] == 0 and scenes >= len(numbers):
            counts[one] = 1
            counts[max(counts, key=lambda other: counts[other])] -= 1
    return {one: found[: counts[one]] for one, found in numbers.items()}


def synthesise(settings: Synthesis, numbers: dict[Split, tuple[int, ...]], *, workers: int = 1) -> int:
    """Write the scenes that are not there yet; a progress bar goes to standard error.

    Args:
        numbers: of the scenes, by split.
        workers: processes; with 1 this process does the work.

    Returns:
        how many scenes were written.

    Raises:
        InvalidInputError: the settings, or the folder has scenes of other settings, or cannot be written to.
    """
    if workers < 1:
        raise InvalidInputError(f"{workers} worker processes, at least 1 is needed")
    wanted = [_Job(settings, split, number) for split, of_split in numbers.items() for number in of_split]
    with _named_errors(settings.root):
        _claim(settings)
        for job in wanted:
            shutil.rmtree(job.part, ignore_errors=True)
        missing = [job for job in wanted if not job.folder.is_dir()]
    with (
        closing(_written_here(missing) if workers == 1 else _written_by(workers, missing)) as finished,
        tqdm(total=len(wanted), initial=len(wanted) - len(missing), desc="synth", unit="scene") as bar,
    ):
        panoramas = 0
        for count in finished:
            panoramas += count
            bar.set_postfix_str(f"{panoramas / bar.format_dict['elapsed']:.1f} panoramas/s", refresh=False)
            bar.update()
    return len(missing)


@dataclass(frozen=True)
class _Job:
    """One scene to write."""

    settings: Synthesis
    split: Split
    number: int

    @property
    def folder(self) -> Path:
        return self.settings.root / scene_name(self.number)

    @property
    def part(self) -> Path:
        """The scene while it is incomplete."""
        return self.settings.root / (scene_name(self.number) + PART_SUFFIX)


def _write_scene(job: _Job, stop: Event | None = None) -> int:
    """Render and write one scene; nothing is left of one that fails.

    Args:
        stop: looked at between rooms; once set, the scene is given up.

    Returns:
        how many panoramas were written.

    Raises:
        DatasetError: it cannot be written.
    """
    settings, split = job.settings, SPLIT_NUMBERS[job.split]
    home, rng = home_of(split, settings.seed, job.number)
    renderer = renderer_cache_of(split, settings.seed, settings.textures).renderer(settings.height, 2 * settings.height)
    shots = stage_rooms(home, rng)
    try:
        with _named_errors(job.part):
            job.part.mkdir()
            write_annotation(job.part, home.plan, home.openings)
            for shot in shots:
                if stop is not None and stop.is_set():
                    return 0
                _write_room(job.part / RENDERING_FOLDER / room_id(shot.room_index) / "panorama", shot, renderer)
            job.part.rename(job.folder)
    finally:
        # Gone already when it was renamed.
        shutil.rmtree(job.part, ignore_errors=True)
    return PICTURES_PER_ROOM * len(shots)


def _write_room(folder: Path, shot: Shot, renderer: PanoramaRenderer) -> None:
    folder.mkdir(parents=True)
    write_camera(folder, shot.home.plan.rooms[shot.room_index], shot.position_m, shot.camera_height_m)
    for furniture in FURNITURE_LEVELS:
        pictures, depth_m = renderer.render_moods(dataclasses.replace(shot, furniture=furniture), MOODS)
        (folder / furniture).mkdir()
        for mood, pixels in zip(MOODS, pictures.numpy(), strict=True):
            write_picture(folder / furniture / f"rgb_{mood}light.png", pixels)
        write_depth(folder / furniture / "depth.png", depth_m.numpy())


def _claim(settings: Synthesis) -> None:
    """Mark a new folder with the settings, or check that it has scenes of the same."""
    root, marker = settings.root, settings.marker
    path = root / SYNTHETIC_FILE
    root.mkdir(parents=True, exist_ok=True)
    found = Structured3D(root).synthetic
    if found is None:
        foreign = next((entry.name for entry in root.iterdir() if _SCENE.fullmatch(entry.name)), None)
        if foreign is not None:
            raise DatasetError(f"holds '{foreign}' but no {SYNTHETIC_FILE}: its scenes are not synthetic", path=root)
        atomic_write(path, json.dumps(dataclasses.asdict(marker)) + "\n")
    elif found != marker:
        before, now = dataclasses.asdict(found), dataclasses.asdict(marker)
        differences = [f"{key} {before[key]!r}, not {now[key]!r}" for key in before if before[key] != now[key]]
        raise DatasetError(f"its scenes were made with {'; '.join(differences)}", path=root)


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """A full disk, or a folder that may not be written to, is an error of the caller's."""
    try:
        yield
    except OSError as error:
        where = Path(error.filename) if isinstance(error.filename, str) else path
        raise DatasetError(f"cannot be written: {error.strerror or error}", path=where) from error


def _written_here(jobs: Sequence[_Job]) -> Generator[int]:
    """Write scenes in this process; yields their numbers of panoramas."""
    threads = torch.get_num_threads()
    # As in worker processes: how sums are split over threads would show in the last bit.
    torch.set_num_threads(1)
    try:
        yield from map(_write_scene, jobs)
    finally:
        torch.set_num_threads(threads)


def _written_by(workers: int, jobs: Sequence[_Job]) -> Generator[int]:
    """Write scenes in worker processes; yields their numbers of panoramas, in order."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    pool = ProcessPoolExecutor(workers, context, _start_worker, (stop,))
    waiting: deque[Future[int]] = deque()
    try:
        for job in jobs:
            waiting.append(pool.submit(_work, job))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool as error:
        raise DatasetError("a worker process died; fewer may fit into memory", path=jobs[0].settings.root) from error
    finally:
        # After an interruption or an error the workers give up the scenes in the making.
        stop.set()
        pool.shutdown(cancel_futures=True)


# Set once, when a worker process starts: an event can be handed over at no other time.
_stop: Event | None = None


def _start_worker(stop: Event) -> None:
    global _stop
    _stop = stop
    torch.set_num_threads(1)
    # Ctrl-C reaches the whole group of processes; the parent tells its workers what to do.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(job: _Job) -> int:
    return _write_scene(job, _stop)
