"""Evaluation runs: every query of a split is localised and its prediction stored; scoring is separate.

Worker processes of one thread each localise scenes in parallel. Predictions are written in order, so that an
interrupted run resumes where it stopped and ends with the same file.
"""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from functools import lru_cache

import numpy as np
import torch
from tqdm import tqdm

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import DatasetError, InvalidInputError, RunError
from lalaloc_core.evaluate.methods.method import Answer, Method, Pose, Question
from lalaloc_core.evaluate.methods.similarity import ChamferGrid, true_layout
from lalaloc_core.evaluate.runs.albums import predict_album
from lalaloc_core.evaluate.runs.factories import build_dataset, build_method, require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene, collect_error, load_scenes
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.render.sampling import PoseSet, pose_grid

# Fields of a run that may differ when it resumes.
_MAY_DIFFER = {"command", "label", "limit", "skipped"}


def run_evaluation(folder: RunFolder, info: RunInfo, *, workers: int | None = None) -> list[Prediction]:
    """Localise every query of a run, or the rest of an interrupted run; return at most `info.limit` predictions.

    `workers` are processes of one thread each; 0 for this process, None for one per core.
    """
    # Invalid descriptions fail here, before anything is written.
    names = list(build_dataset(info).scenes(info.split))
    build_method(info)
    if not names:
        raise InvalidInputError(f"split '{info.split}' of {info.dataset} is empty")
    is_new = not folder.exists()
    done, skipped = _resume(folder, info)
    limit = math.inf if info.limit is None else info.limit
    if done:
        # Scenes without queries leave no line, so resume after the last scene that has one.
        names = names[names.index(done[-1].scene) + 1 :]
    if len(done) >= limit:
        return done
    with tqdm(total=info.limit, initial=len(done), desc=info.label, unit="query", mininterval=1.0) as bar:
        for predictions, problems in _localise_scenes(info, names, workers):
            kept = predictions[: int(min(limit - len(done), len(predictions)))]
            done += kept
            folder.append(kept)
            bar.update(len(kept))
            if problems:
                skipped = list(dict.fromkeys([*skipped, *map(str, problems)]))
                folder.write_info(dataclasses.replace(info, skipped=tuple(skipped)))
            if len(done) >= limit:
                break
    if not done and is_new:
        folder.remove()
        reason = f"; {len(skipped)} scenes or cameras were skipped, the first: {skipped[0]}" if skipped else ""
        raise InvalidInputError(f"split '{info.split}' of {info.dataset} has no queries{reason}")
    return done


def _resume(folder: RunFolder, info: RunInfo) -> tuple[list[Prediction], list[str]]:
    if not folder.exists():
        folder.write_info(info)
        folder.replace([])
        return [], []
    before = folder.read_info()
    differing = [
        field.name
        for field in dataclasses.fields(RunInfo)
        if field.name not in _MAY_DIFFER and getattr(before, field.name) != getattr(info, field.name)
    ]
    if differing:
        name = differing[0]
        raise RunError(
            f"'{folder.path}' holds a run with {name} {getattr(before, name)!r}, not {getattr(info, name)!r}; "
            "choose another folder with --out"
        )
    done = folder.read_predictions()
    if done and (info.limit is None or len(done) < info.limit):
        # An interruption or a limit can cut the last scene, so it is repeated.
        done = [prediction for prediction in done if prediction.scene != done[-1].scene]
    done = done[: info.limit]
    folder.write_info(dataclasses.replace(info, skipped=before.skipped))
    folder.replace(done)
    return done, list(before.skipped)


def _localise_scenes(
    info: RunInfo, names: Sequence[str], workers: int | None
) -> Iterator[tuple[list[Prediction], list[DatasetError]]]:
    """Yield predictions and problems by scene, in order; workers are a few scenes ahead."""
    description = json.dumps(dataclasses.asdict(info))
    workers = os.cpu_count() or 1 if workers is None else workers
    if workers == 0:
        yield from (_localise_scene(description, name) for name in names)
        return
    waiting: deque[Future[tuple[list[Prediction], list[DatasetError]]]] = deque()
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        for name in names:
            waiting.append(pool.submit(_localise_scene, description, name))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


@lru_cache(maxsize=1)
def _session(description: str) -> tuple[RunInfo, Dataset, Method | LocalModel]:
    """Return the state of a worker process between scenes; a `LocalModel` solves albums."""
    torch.set_num_threads(1)
    info = build_config(RunInfo, json.loads(description))
    method = LocalModel(require_bundle(info)) if info.albums else build_method(info)
    return info, build_dataset(info), method


def _localise_scene(description: str, name: str) -> tuple[list[Prediction], list[DatasetError]]:
    """Return the predictions of one scene and, with `skip_bad`, the errors of unusable scenes and cameras."""
    info, dataset, method = _session(description)
    problems: list[DatasetError] | None = [] if info.skip_bad else None
    predictions: list[Prediction] = []
    for scene in load_scenes(dataset, [name], problems):
        if isinstance(method, LocalModel):
            with collect_error(problems):
                predictions += predict_album(scene, info, method, problems)
            continue
        evaluator = _SceneEvaluator(scene, info)
        for camera in scene.cameras:
            with collect_error(problems):
                predictions.append(evaluator.predict(camera, method))
    return predictions, problems or []


def question_of(scene: Scene, camera: Camera, info: RunInfo, grid: PoseSet) -> Question:
    """Return the question of a run about one camera."""
    appearance = Appearance(info.furniture, info.lighting)
    return Question(
        plan=scene.plan,
        grid=grid,
        grid_step_m=info.grid_step_m,
        camera=camera,
        kind=info.kind,
        photograph=scene.photograph(camera, appearance) if info.kind == "photograph" else None,
        heading_known=info.heading_known,
    )


class _SceneEvaluator:
    """Queries of one scene, with the recall of retrieval."""

    def __init__(self, scene: Scene, info: RunInfo) -> None:
        self._scene, self._info = scene, info
        self._grid: PoseSet = pose_grid(scene.plan, info.grid_step_m)
        self._layouts: dict[float, ChamferGrid] = {}

    def predict(self, camera: Camera, method: Method) -> Prediction:
        info, scene = self._info, self._scene
        question = question_of(scene, camera, info, self._grid)
        answer = method.locate(question)
        layout_hit, pose_hit = self._hits(question, answer)
        return Prediction(
            scene=scene.name,
            camera=camera.name,
            room=scene.plan.rooms[camera.room_index].name,
            camera_height_m=camera.camera_height_m,
            truth=Pose.at(camera.position_m, camera.room_index, camera.heading),
            stages=answer.stages,
            layout_hit=layout_hit,
            pose_hit=pose_hit,
            room_rank=answer.rank_of_room(camera.room_index),
            signals=answer.signals,
            information=None if answer.information is None else tuple(map(tuple, answer.information.tolist())),
            candidates=answer.candidates,
            confidence=answer.confidence,
            heading_confidence=answer.heading_confidence,
            found_height_m=answer.camera_height_m,
            timings_ms=answer.timings_ms,
            facts=tuple(sorted(getattr(question.photograph, "facts", ()))),
        )

    def _hits(self, question: Question, answer: Answer) -> tuple[bool | None, bool | None]:
        """Return whether retrieval chose the pose with the nearest layout, the first of equals, and the nearest one."""
        if answer.retrieved is None:
            return None, None
        height = question.camera.camera_height_m
        if height not in self._layouts:
            self._layouts[height] = ChamferGrid(self._scene.plan, self._grid, height)
        layouts = self._layouts[height]
        layout = layouts.nearest(true_layout(question, layouts.columns))
        pose = int(np.linalg.norm(self._grid.position_m - question.camera.position_m, axis=1).argmin())
        return layout == answer.retrieved, pose == answer.retrieved
