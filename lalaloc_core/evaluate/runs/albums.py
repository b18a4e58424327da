"""Albums in evaluation: the photographs of one place, solved together and compared with their true poses."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lalaloc_core.errors import DatasetError, InvalidInputError, InvalidPhotographError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, DatasetPhotograph, FilePhotograph, Scene, collect_error
from lalaloc_core.learn.data.views import ViewPhotograph, encode_jpeg
from lalaloc_core.localise.album.entry import AlbumPhotograph, Correction, photograph_entry
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.pins import Album, Pin, PinPose
from lalaloc_core.localise.album.solve import solve_album
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size, sphere_size
from lalaloc_core.localise.local_model import GRID_STEP_M, LocalModel
from lalaloc_core.photograph import StatedCamera, open_photograph
from lalaloc_core.photograph.exif import Taken

# Id of the plan of an album of one plan, and the least probability whose logarithm counts.
PLAN_ID, _LEAST = "plan", 1e-3
# Size of generated spheres, pixels.
_SPHERE_SIZE = (512, 1024)


# Room of a pin: the ids of its plan and of the room; None for none of the rooms.
RoomKey = tuple[str, str] | None


@dataclass(frozen=True, eq=False)
class AlbumCase:
    """An album with the true poses of its photographs."""

    ground: AlbumGround
    photographs: list[AlbumPhotograph]
    truth: list[Pose]

    @classmethod
    def of(
        cls,
        model: LocalModel,
        plan: FloorPlan,
        photographs: list[AlbumPhotograph],
        truth: list[Pose],
        step_m: float = GRID_STEP_M,
    ) -> AlbumCase:
        """Return the case of one plan, with poses `step_m` apart."""
        grid = model.grid(plan, plan.camera_height_m, step_m)
        return cls(AlbumGround.of_plan(PLAN_ID, plan, grid), photographs, truth)

    @property
    def with_rooms(self) -> RoomAlbum:
        """The album with the room of every photograph."""
        rooms: list[RoomKey] = [(PLAN_ID, self.ground.plan.rooms[pose.room_index].id) for pose in self.truth]
        return RoomAlbum(self.ground, self.photographs, rooms)

    @property
    def without_order(self) -> AlbumCase:
        """The album without times."""
        untimed = [replace(each, taken=replace(each.taken, at=None)) for each in self.photographs]
        return replace(self, photographs=untimed)

    def solve(self, model: LocalModel, memory: AlbumMemory) -> Sequence[Pin]:
        """Return a pin for every photograph."""
        return solve_album(self.ground, model.encoder, self.photographs, memory=memory).pins

    def pose(self, pin: PinPose) -> Pose:
        """Return the pose of a pin; an unknown heading is 0."""
        rooms = [room.id for room in self.ground.plan.rooms]
        return Pose(x_m=pin.x_m, y_m=pin.y_m, room_index=rooms.index(pin.room_id), heading_deg=pin.heading_deg or 0.0)

    def clicks(self, model: LocalModel, memory: AlbumMemory) -> int:
        """Return how many pins must be corrected, the least sure wrong one first, until all rooms are right."""
        rooms = [self.ground.plan.rooms[truth.room_index].id for truth in self.truth]
        case = self
        for count in range(len(rooms)):
            pins = case.solve(model, memory)
            wrong = [
                (pin.confidence, number)
                for number, (pin, room) in enumerate(zip(pins, rooms, strict=True))
                if pin.pose is None or pin.pose.room_id != room
            ]
            if not wrong:
                return count
            number = min(wrong)[1]
            stated = Correction(kind="room", plan_id=PLAN_ID, room_id=rooms[number])
            corrected = replace(case.photographs[number], correction=stated)
            photographs = [*case.photographs[:number], corrected, *case.photographs[number + 1 :]]
            case = replace(case, photographs=photographs)
        return len(rooms)


class RoomAlbum(NamedTuple):
    """An album with the true room of every photograph."""

    ground: AlbumGround
    photographs: list[AlbumPhotograph]
    rooms: list[RoomKey]

    def solve(self, encoder: PhotographEncoder, memory: AlbumMemory) -> Album:
        """Return the solved album."""
        return solve_album(self.ground, encoder, self.photographs, memory=memory)

    def figures(self, encoder: PhotographEncoder, memory: AlbumMemory) -> dict[str, float]:
        """Return counts of pins, see `pin_figures`."""
        return pin_figures(self.solve(encoder, memory).pins, self.rooms)

    def elsewhere(self, other: RoomAlbum) -> RoomAlbum:
        """Return the photographs in the plan of another album."""
        return RoomAlbum(other.ground, self.photographs, [None] * len(self.rooms))


def pin_figures(pins: Sequence[Pin], truth: Sequence[RoomKey]) -> dict[str, float]:
    """Return counts of pins by whether their room is right, and the mean log probability of the right room."""
    right, logs = list[bool](), list[float]()
    for pin, room in zip(pins, truth, strict=True):
        shares = {(row.plan_id, row.room_id): row.probability for row in pin.rooms}
        probability = pin.elsewhere if room is None else shares.get(room, 0.0)
        logs.append(math.log(max(probability, _LEAST)))
        right.append(pin.pose is not None and (pin.pose.plan_id, pin.pose.room_id) == room)
    sure, aside = (np.array([pin.state == state for pin in pins], bool) for state in ("sure", "set_aside"))
    own, is_right = np.array([room is not None for room in truth], bool), np.array(right, bool)
    return {
        "n": int(own.sum()),
        "mean_log_probability": float(np.mean(logs)) if logs else 0.0,
        "right_room": int(is_right.sum()),
        "set_aside": int((aside & own).sum()),
        "sure": int((sure & own).sum()),
        "sure_and_wrong": int((sure & own & ~is_right).sum()),
        "elsewhere": int((~own).sum()),
        "elsewhere_sure": int((sure & ~own).sum()),
        "elsewhere_set_aside": int((aside & ~own).sum()),
    }


def album_entry(
    model: LocalModel, id: str, content: bytes, stated: StatedCamera, taken: Taken | None = None, name: str = ""
) -> AlbumPhotograph:
    """Return the entry of a photograph's file, with the given time and camera or those of its metadata."""
    manifest = model.bundle.manifest
    view = open_photograph(
        content, sphere_size=sphere_size(manifest), stated=stated, patch_size=patch_size(manifest), purpose="album"
    )
    return photograph_entry(id, model.encoder.with_features(view), taken, name)


def predict_album(
    scene: Scene, info: RunInfo, model: LocalModel, problems: list[DatasetError] | None
) -> list[Prediction]:
    """Solve the photographs of a scene as one album; nothing is stated about their poses.

    Photographs that cannot be used are left out and their errors appended to `problems`; None raises the first error.
    """
    cameras, photographs = list[Camera](), list[AlbumPhotograph]()
    for camera in scene.cameras:
        with collect_error(problems):
            photograph = scene.photograph(camera, Appearance(info.furniture, info.lighting))
            try:
                photographs.append(_entry(model, camera.name, photograph))
            except InvalidPhotographError as error:
                raise DatasetError(str(error), scene=scene.name, room=camera.name) from error
            cameras.append(camera)
    if not photographs:
        return []
    truth = [Pose.at(camera.position_m, camera.room_index, camera.heading) for camera in cameras]
    case = AlbumCase.of(model, scene.plan, photographs, truth, info.grid_step_m)
    memory, begin = AlbumMemory(), time.perf_counter()
    try:
        pins = case.solve(model, memory)
    except InvalidInputError as error:
        raise DatasetError(str(error), scene=scene.name) from error
    each_ms = 1e3 * (time.perf_counter() - begin) / len(pins)
    clicks = case.clicks(model, memory)
    return [_prediction(case, scene, camera, pin, clicks, each_ms) for camera, pin in zip(cameras, pins, strict=True)]


def _prediction(case: AlbumCase, scene: Scene, camera: Camera, pin: Pin, clicks: int, each_ms: float) -> Prediction:
    suggested = [case.pose(suggestion.pose).room_index for suggestion in pin.suggestions]
    return Prediction(
        scene=scene.name,
        camera=camera.name,
        room=scene.plan.rooms[camera.room_index].name,
        camera_height_m=camera.camera_height_m,
        truth=Pose.at(camera.position_m, camera.room_index, camera.heading),
        stages={} if pin.pose is None else {"album": case.pose(pin.pose)},
        room_rank=suggested.index(camera.room_index) + 1 if camera.room_index in suggested else None,
        confidence=pin.within_1m,
        room_confidence=pin.confidence,
        clicks=clicks,
        timings_ms={"album": each_ms},
    )


def _entry(model: LocalModel, name: str, photograph: DatasetPhotograph) -> AlbumPhotograph:
    """Return the entry of a photograph: a file of any projection, a view, or a generated sphere."""
    if isinstance(photograph, FilePhotograph):
        content, stated = photograph.content(), StatedCamera()
    elif isinstance(photograph, ViewPhotograph):
        content, stated = photograph.content(), photograph.stated_camera
    else:
        content, stated = encode_jpeg(photograph.image(*_SPHERE_SIZE)), StatedCamera(projection="equirectangular")
    return album_entry(model, name, content, stated)
