"""Retrieval with the truth at hand: the best that a layout metric, or any retrieval at all, can do on a grid."""

from __future__ import annotations

import numpy as np

from lalaloc_core.localise.pipeline import StageClock
from lalaloc_core.methods.kept import KeptPerPlan
from lalaloc_core.methods.method import Answer, Found, Question
from lalaloc_core.methods.similarity import LayoutGrid, LayoutMetric, layout_grid, true_layout


class SimilarityRetrieval:
    """The grid pose whose layout is nearest the true layout by one metric (paper, table of layout-similarity metrics).

    By Chamfer distance it is the paper's oracle, and its choice is what Layout R@1 counts as right.
    """

    def __init__(self, metric: LayoutMetric = "chamfer") -> None:
        self.metric: LayoutMetric = metric
        self._grids: KeptPerPlan[LayoutGrid] = KeptPerPlan()

    def answer(self, question: Question) -> Answer:
        """Retrieve with the true layout."""
        grid = self._grid(question)
        clock = StageClock()
        with clock.stage("retrieve"):
            index = grid.nearest(true_layout(question, grid.columns))
        return _retrieved(question, index, clock)

    def _grid(self, question: Question) -> LayoutGrid:
        height = question.camera.camera_height_m
        return self._grids.get(
            question.plan,
            (height, question.grid_step_m),
            lambda: layout_grid(self.metric, question.plan, question.grid, height),
        )


class PoseOracle:
    """The grid pose nearest the true position: row "Pose" of the same table, the bound of every retrieval."""

    def answer(self, question: Question) -> Answer:
        """Look up the nearest grid pose."""
        clock = StageClock()
        with clock.stage("retrieve"):
            index = int(np.linalg.norm(question.grid.position_m - question.camera.position_m, axis=1).argmin())
        return _retrieved(question, index, clock)


def _retrieved(question: Question, index: int, clock: StageClock) -> Answer:
    found = Found(
        x_m=float(question.grid.position_m[index, 0]),
        y_m=float(question.grid.position_m[index, 1]),
        room_index=int(question.grid.room_index[index]),
        heading=question.camera.heading,
    )
    return Answer(stages={"retrieval": found}, retrieved=index, timings_ms=clock.timings_ms)
