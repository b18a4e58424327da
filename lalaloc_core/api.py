"""Localisation of photographs in floor plans, in this process: the interface that the package promises.

from lalaloc_core import LaLaLoc, read_plan

answer = LaLaLoc().localise(read_plan("flat.dxf"), "kitchen.jpg")
answer.room, answer.position, answer.confidence
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from lalaloc_core.bundle import Bundle, Manifest, default_bundle
from lalaloc_core.errors import (
    ForeignFeaturesError,
    InvalidFeaturesError,
    InvalidFilmError,
    InvalidFloorPlanError,
    InvalidInputError,
    InvalidPhotographError,
)
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportedPlan, ImportOptions, building_name, import_plan
from lalaloc_core.localise.album.entry import AlbumPhotograph, photograph_entry
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.pins import Album
from lalaloc_core.localise.album.solve import MAX_PHOTOGRAPHS, solve_album
from lalaloc_core.localise.answers.compose import compose_answer, compose_tracked
from lalaloc_core.localise.answers.documents import Answer, Ground, Spot, TrackedAnswer, TurnAnswer
from lalaloc_core.localise.answers.pinned import PinnedAlbum, PinnedPhotograph
from lalaloc_core.localise.answers.turns import Turn, compose_turn
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight, stated_height
from lalaloc_core.localise.query.query import UNKNOWN_HEADING, check_height_m, known_heading
from lalaloc_core.localise.search.pipeline import run_steps
from lalaloc_core.localise.tracking import Odometry, TrackState
from lalaloc_core.localise.tracking.tracked_plans import TrackedPlans
from lalaloc_core.localise.tracking.tracking_filter import Tracked, track_steps
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film, read_film
from lalaloc_core.photograph.picture_folders import MAX_TURN_PHOTOGRAPHS, pictures_in, turn_files
from lalaloc_core.photograph.turn_angles import TurnAngles
from lalaloc_core.photograph.turned import level_turn, open_of_turn
from lalaloc_core.shown_text import printable

PlanSource = FloorPlan | ImportedPlan | str | PathLike[str] | bytes | Image.Image | UInt8[np.ndarray, "h w *c"]
PhotographSource = str | PathLike[str] | bytes | Image.Image | UInt8[np.ndarray, "h w 3"] | Photograph
TurnSource = Sequence[PhotographSource] | str | PathLike[str] | bytes
# Plans whose pose grids are kept for the next photograph.
_GRIDS = 8


def read_plan(source: PlanSource, **options: Any) -> FloorPlan:
    """Read a floor plan.

    Args:
        source: a file of any format of docs/how-to/import-a-plan.md, as a path or its bytes, or a picture of a plan.
        **options: facts that the file does not give, such as `metres_per_pixel=0.01` or `level="1"`; see
            `lalaloc_core.importers.ImportOptions`.

    Returns:
        the plan.

    Raises:
        InvalidFloorPlanError: the file cannot be read, is no valid plan, or exceeds a limit.
        SeveralLevelsError: the file has several levels, and the option `level` chooses none.
        MissingExtraError: a library for the file's format is not installed.
    """
    if isinstance(source, FloorPlan):
        return source
    if isinstance(source, ImportedPlan):
        return source.plan()
    building = building_name(Path(source).name) if isinstance(source, str | PathLike) else None
    content = plan_content(Path(source)) if isinstance(source, str | PathLike) else _encoded(source)
    return import_plan(content, ImportOptions(**options), building=building).plan()


def plan_content(path: Path) -> bytes:
    """Return the bytes of a plan file; of the YAML file of a ROS map, an archive with its picture.

    Raises:
        InvalidFloorPlanError: the file cannot be read.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        from lalaloc_core.importers.common.bounded_files import pack
        from lalaloc_core.importers.formats.ros import map_files

        return pack(map_files(path))
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidFloorPlanError(f"'{path}' cannot be read: {error.strerror}") from error


class LaLaLoc:
    """Model that localises photographs in floor plans, in this process and on one thread.

    Photographs are paths, bytes of picture files or of features, PIL pictures, or arrays of RGB values (h, w, 3). Full
    spheres, ordinary, fisheye and panorama-mode photographs are told apart by themselves. Plans are those of
    `read_plan`, or what it reads; the pose grids of the last ones stay in memory.
    """

    def __init__(self, model: str | PathLike[str] | Bundle | None = None) -> None:
        """Load a model.

        Args:
            model: folder of a model bundle, or an open one; None for the shipped one.

        Raises:
            BundleError: there is no bundle, or it is damaged.
        """
        self.bundle = model if isinstance(model, Bundle) else Bundle.open(Path(model or default_bundle()))
        self._model = LocalModel(self.bundle)
        self._ground = lru_cache(_GRIDS)(lambda plan, height_m: Ground(plan, self._model.grid(plan, height_m)))

    def localise(
        self,
        plan: PlanSource,
        photograph: PhotographSource,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float = 0.0,
        camera_height_m: float | None = None,
        camera: StatedCamera | None = None,
    ) -> Answer:
        """Localise a photograph in a plan.

        Args:
            plan: the floor plan.
            photograph: the photograph.
            heading_deg: azimuth of its centre, clockwise from the plan's +y; by default the photograph's compass if
                the plan has north, else it is searched.
            heading_tolerance_deg: largest error of `heading_deg`, at most 45.
            camera_height_m: metres above the floor; by default the plan's, else estimated.
            camera: projection, field of view and tilt, where the photograph does not say so itself.

        Returns:
            the pose, its confidence, and other possible poses.

        Raises:
            InvalidPhotographError: the photograph cannot be read, or the model cannot encode it.
            InvalidFloorPlanError: the plan cannot be read.
            InvalidPoseError: the camera height is not possible in the plan.
        """
        plan = read_plan(plan)
        height = self._height(plan, camera_height_m)
        view = self._open(photograph, camera)
        known = known_heading(plan.north, heading_deg, heading_tolerance_deg, view.compass_heading)
        query = self._model.encoder.query(view, known.heading, height, heading_tolerance=known.tolerance)
        ground = self._ground(plan, self._grid_height_m(plan, height))
        found = self._model.localise(plan, ground.grid, query)
        return compose_answer(found, ground, Spot(view), known, self.bundle)

    def localise_turn(
        self,
        plan: PlanSource,
        photographs: TurnSource,
        *,
        camera_height_m: float | None = None,
        camera: StatedCamera | None = None,
    ) -> TurnAnswer:
        """Localise photographs that were taken while turning on one spot, or a film of such a turn.

        Args:
            plan: the floor plan.
            photographs: at least two photographs in the order in which they were taken, none of them a full sphere;
                the path of a folder of them, in the order of their times or names; or a film, as a path or its bytes.
            camera_height_m: metres above the floor; by default the plan's, else estimated.
            camera: projection, field of view and tilt, where the photographs do not say so themselves.

        Returns:
            the pose of the first photograph, the confidence of all together, and the pose of each.

        Raises:
            InvalidPhotographError: a photograph cannot be read, or the model cannot encode it.
            InvalidFilmError: the film cannot be read, or shows no turn.
            InvalidFloorPlanError: the plan cannot be read.
            InvalidPoseError: the camera height is not possible in the plan.
        """
        plan = read_plan(plan)
        height = self._height(plan, camera_height_m)
        opened, angles, film = read_turn(photographs, self.bundle.manifest, camera or StatedCamera())
        turn = Turn.of_overlap(opened, [UNKNOWN_HEADING] * len(opened), height, angles, film)
        ground = self._ground(plan, self._grid_height_m(plan, height))
        return compose_turn(turn, self._model.search_turn(turn, ground), ground, self.bundle)

    def pin(
        self,
        plans: PlanSource | Sequence[PlanSource],
        photographs: Sequence[PhotographSource] | str | PathLike[str],
        *,
        camera: StatedCamera | None = None,
        progress: Callable[[str, int, int], object] = lambda stage, done, count: None,
    ) -> PinnedAlbum:
        """Pin photographs of one visit to a plan, or to the levels of a building, all together.

        Args:
            plans: the floor plan, or those of several levels.
            photographs: up to 500 photographs in any order, or the path of a folder of them.
            camera: projection, field of view and tilt of all photographs.
            progress: called with the stage, "read" or "pin", and the numbers of photographs done and in all.

        Returns:
            the pin of each photograph; those that cannot be read have none.

        Raises:
            InvalidPhotographError: none of the photographs can be read.
            InvalidInputError: there are too many photographs, or the plans are too large.
            InvalidFloorPlanError: a plan cannot be read.
        """
        several = plans if isinstance(plans, Sequence) and not isinstance(plans, str | bytes) else [plans]
        read = [read_plan(plan) for plan in several]
        sources = pictures_in(Path(photographs)) if isinstance(photographs, str | PathLike) else photographs
        if len(sources) > MAX_PHOTOGRAPHS:
            raise InvalidInputError(
                f"{len(sources)} photographs are too many; the limit is {MAX_PHOTOGRAPHS}: divide them"
            )
        rows: list[PinnedPhotograph] = []
        entries: dict[str, AlbumPhotograph] = {}
        for number, source in enumerate(sources, start=1):
            rows.append(self._read_for_album(number, source, camera or StatedCamera(), entries))
            progress("read", number, len(sources))
        if not entries:
            raise InvalidPhotographError(f"none of {len(rows)} photographs can be read; the first: {rows[0].reason}")
        ids = _plan_ids(read)
        grids = [self._ground(plan, plan.camera_height_m).grid for plan in read]
        if len(read) == 1:
            ground = AlbumGround.of_plan(ids[0], read[0], grids[0])
        else:
            ground = AlbumGround(tuple(ids), MergedPlans.of(read, grids, read[0].camera_height_m))
        album = solve_album(
            ground,
            self._model.encoder,
            list(entries.values()),
            progress=lambda done: progress("pin", done, len(entries)),
        )
        return _pinned_album(read, ids, album, rows)

    def track(self, plan: PlanSource, *, camera_height_m: float | None = None) -> Track:
        """Begin to follow a camera through a plan; `Track.add` takes its photographs one after another.

        Args:
            plan: the floor plan.
            camera_height_m: metres above the floor; by default the plan's, else estimated.

        Returns:
            the track, without a photograph.

        Raises:
            InvalidFloorPlanError: the plan cannot be read.
            InvalidPoseError: the camera height is not possible in the plan.
        """
        plan = read_plan(plan)
        return Track(self, plan, self._height(plan, camera_height_m))

    def _open(self, source: PhotographSource, stated: StatedCamera | None) -> Photograph:
        """Read a photograph, or its features."""
        if isinstance(source, Photograph):
            return source
        with named(source):
            view = self._model.open_any(photograph_content(source), stated or StatedCamera())
            self._model.encoder.check(view)
            return view

    def _read_for_album(
        self, number: int, source: PhotographSource, stated: StatedCamera, entries: dict[str, AlbumPhotograph]
    ) -> PinnedPhotograph:
        """Read a photograph into the entries of an album; copies of an earlier one have its entry."""
        name = printable(Path(source).name) if isinstance(source, str | PathLike) else ""
        try:
            content = photograph_content(source)
            id = hashlib.sha256(content).hexdigest()
            if id not in entries:
                view = self._model.encoder.with_features(self._model.open(content, stated, purpose="album"))
                entries[id] = photograph_entry(id, view, name=name)
        except InvalidPhotographError as error:
            return PinnedPhotograph(number, name, None, reason=str(error))
        at = entries[id].taken.at
        # As the service answers it: the time at the place, without its zone.
        taken = "" if at is None else at.replace(tzinfo=None).isoformat(sep=" ", timespec="seconds")
        return PinnedPhotograph(number, name, id, taken=taken)

    def _grid_height_m(self, plan: FloorPlan, height: CameraHeight) -> float:
        """Return the camera height of the pose grid; only models that compare latents alone need one per height."""
        return plan.camera_height_m if self._model.encoder.predicts_profile else height.height_m

    @staticmethod
    def _height(plan: FloorPlan, camera_height_m: float | None) -> CameraHeight:
        if camera_height_m is not None:
            check_height_m(plan, camera_height_m)
        return stated_height(plan, camera_height_m)


class Track:
    """Camera that is followed through a plan.

    Attributes:
        answers: the answers so far, one per photograph.
    """

    def __init__(self, model: LaLaLoc, plan: FloorPlan, height: CameraHeight) -> None:
        """Begin a track; see `LaLaLoc.track`."""
        self._owner, self._height = model, height
        self._ground = model._ground(plan, model._grid_height_m(plan, height))
        self._plans = TrackedPlans.of_plan(plan, self._ground.grid)
        self._state: TrackState | None = None
        self.answers: list[TrackedAnswer] = []

    def add(
        self, photograph: PhotographSource, motion: Odometry | None = None, *, camera: StatedCamera | None = None
    ) -> TrackedAnswer:
        """Follow the camera to its next photograph.

        Args:
            photograph: the photograph.
            motion: measured motion since the photograph before; None if it is unknown.
            camera: projection, field of view and tilt, where the photograph does not say so itself.

        Returns:
            the pose at this photograph, with everything that was seen before.

        Raises:
            InvalidPhotographError: the photograph cannot be read, or the model cannot encode it; the track stays as
                it was.
        """
        model, plan = self._owner._model, self._ground.plan
        view = self._owner._open(photograph, camera)
        query = model.encoder.query(view, None, self._height)
        state = self._state or TrackState.first(len(query.roll))
        known = known_heading(plan.north, None, 0.0, view.compass_heading)
        steps = track_steps(self._plans, model.encoder.layouts, state, query, motion, known_heading=known)
        found: Tracked = run_steps(steps, model.refiner)
        self._state = found.state
        self.answers.append(compose_tracked(found, self._ground, Spot(view), self._owner.bundle, odometry=motion))
        return self.answers[-1]

    def document(self) -> list[dict[str, Any]]:
        """Return the answers as plain data."""
        return [answer.document() for answer in self.answers]


def read_turn(
    source: TurnSource, manifest: Manifest, stated: StatedCamera
) -> tuple[Sequence[Photograph], Sequence[TurnAngles], Film | None]:
    """Read photographs of one spot, a folder of them, or a film; see `LaLaLoc.localise_turn`.

    Returns:
        the photographs, their angles, and the film.
    """
    is_path = isinstance(source, str | PathLike)
    size = patch_size(manifest)
    if isinstance(source, bytes) or (is_path and not Path(source).is_dir()):
        try:
            film = read_film(photograph_content(source), stated=stated, patch_size=size)
        except InvalidFilmError as error:
            raise InvalidFilmError(f"'{source}': {error}" if is_path else str(error)) from error
        return film.photographs, film.angles, film
    sources, left_out = turn_files(Path(source)) if is_path else (source, [])
    if not 2 <= len(sources) <= MAX_TURN_PHOTOGRAPHS:
        where = f"'{source}'" if is_path else "the turn"
        text = f"{where} has {len(sources)} photographs; a turn has 2 to {MAX_TURN_PHOTOGRAPHS}"
        raise InvalidInputError("; ".join([text, *left_out]))
    opened = []
    for each in sources:
        with named(each):
            content = photograph_content(each)
            opened.append(open_of_turn(content, stated, sphere_size=sphere_size(manifest), patch_size=size))
    opened[0] = replace(opened[0], warnings=(*left_out, *opened[0].warnings))
    return *level_turn(opened, size), None


def photograph_content(source: PhotographSource) -> bytes:
    """Return the bytes of a photograph.

    Raises:
        InvalidPhotographError: the file cannot be read.
    """
    if not isinstance(source, str | PathLike):
        return _encoded(source)
    try:
        return Path(source).read_bytes()
    except OSError as error:
        raise InvalidPhotographError(f"'{source}' cannot be read: {error.strerror}") from error


def _encoded(source: Any) -> bytes:
    """Return a picture as a file, with its EXIF metadata; bytes as they are."""
    if isinstance(source, bytes):
        return source
    picture = Image.fromarray(source) if isinstance(source, np.ndarray) else source
    content = io.BytesIO()
    picture.save(content, "PNG", compress_level=1, exif=picture.getexif())
    return content.getvalue()


@contextmanager
def named(source: object) -> Iterator[None]:
    """Name the file of a photograph in errors about it."""
    if not isinstance(source, str | PathLike):
        yield
        return
    try:
        yield
    except (InvalidFeaturesError, ForeignFeaturesError) as error:
        raise InvalidPhotographError(f"'{source}': {error}") from error
    except InvalidPhotographError as error:
        if str(error).startswith(f"'{source}'"):
            raise
        raise InvalidPhotographError(f"'{source}': {error}; see docs/how-to/take-photographs.md") from error


def _plan_ids(plans: Sequence[FloorPlan]) -> list[str]:
    """Return a name for each plan that stays in its next revision: that of the level, or "plan" for the only one."""
    if len(plans) == 1:
        return ["plan"]
    names = [plan.name for plan in plans]
    return [name if names.count(name) == 1 else f"{name} {number}" for number, name in enumerate(names, start=1)]


def _pinned_album(
    plans: Sequence[FloorPlan], ids: Sequence[str], album: Album, rows: Iterable[PinnedPhotograph]
) -> PinnedAlbum:
    """Return the album with its pins and notes on unreadable files and copies."""
    pins = {pin.photograph_id: pin for pin in album.pins}
    photographs = [row if row.id is None else replace(row, pin=pins[row.id]) for row in rows]
    unread, notes = [row for row in photographs if row.id is None], []
    for reason in dict.fromkeys(row.reason for row in unread):
        names = [f"'{row.name}'" for row in unread if row.reason == reason]
        notes.append(f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} set aside: {reason}")
    copies = sum(row.id is not None for row in photographs) - len(pins)
    if copies:
        notes.append(f"copies of other files, which have the same pin: {copies}")
    notes += album.warnings
    return PinnedAlbum(plans=plans, plan_ids=ids, album=album, photographs=photographs, notes=notes)
