"""Retrieval with the truth at hand: the best that a layout metric, or any retrieval at all, can do on a grid."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
from cachetools import LRUCache, cachedmethod

from lalaloc_core.evaluate.methods.caching import GRIDS_CACHED, grid_key
from lalaloc_core.evaluate.methods.method import Answer, Found, Question
from lalaloc_core.evaluate.methods.similarity import LayoutGrid, LayoutMetric, layout_grid, true_layout
from lalaloc_core.localise.pipeline import StageClock


class SimilarityRetrieval:
    """The grid pose whose layout is nearest the true layout by one metric (paper, table of layout-similarity metrics).

    By Chamfer distance it is the paper's oracle, and its choice is what Layout R@1 counts as right.
    """

    def __init__(self, metric: LayoutMetric = "chamfer") -> None:
        self.metric: LayoutMetric = metric
        self._grids: LRUCache[Any, LayoutGrid] = LRUCache(GRIDS_CACHED)

    def answer(self, question: Question) -> Answer:
        """Retrieve with the true layout."""
        grid = self._grid(question)
        clock = StageClock()
        with clock.stage("retrieve"):
            index = grid.nearest(true_layout(question, grid.columns))
        return _retrieved(question, index, clock)

    @cachedmethod(attrgetter("_grids"), key=grid_key)
    def _grid(self, question: Question) -> LayoutGrid:
        return layout_grid(self.metric, question.plan, question.grid, question.camera.camera_height_m)


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
