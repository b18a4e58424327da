"""Solve of an album: the pins of all photographs at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.memory import AlbumMemory
from lalaloc_core.localise.album.pins import Album, Pin, Suggestion
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import stated_height
from lalaloc_core.localise.refine import refine_walls
from lalaloc_core.localise.search.pipeline import LocaliseConfig, localise

MAX_PHOTOGRAPHS = 500
# Pins whose room is right with at least this probability are sure.
SURE = 0.8
_SUGGESTIONS = 5


def solve_album(
    ground: AlbumGround,
    encoder: PhotographEncoder,
    photographs: Sequence[AlbumPhotograph],
    *,
    memory: AlbumMemory | None = None,
    by_time: bool = True,
    progress: Callable[[int], None] = lambda _: None,
) -> Album:
    """Pin the photographs of an album.

    Args:
        ground: the plan, or the plans of a venue.
        encoder: encoder of the model that the entries were made with.
        photographs: at most 500, with different ids; their order does not matter.
        memory: what earlier solves found, filled in place; None for nothing.
        by_time: use the times at which the photographs were taken.
        progress: called with the number of photographs that were compared with the plan.

    Raises:
        InvalidInputError: there are too many photographs, or two with one id.
        InvalidCorrectionError: a correction names a plan or a room that the ground does not have.
    """
    ids = {photograph.id for photograph in photographs}
    if len(photographs) > MAX_PHOTOGRAPHS:
        raise InvalidInputError(f"the album has {len(photographs)} photographs; the limit is {MAX_PHOTOGRAPHS}")
    if len(ids) < len(photographs):
        raise InvalidInputError("two photographs of the album have the same id; every photograph is added once")
    memory = AlbumMemory() if memory is None else memory
    memory.use(ground, encoder.manifest)
    memory.keep(ids)
    pins = []
    for number, photograph in enumerate(photographs):
        pins.append(_alone(ground, encoder, photograph))
        progress(number + 1)
    return Album(pins=tuple(pins))


def _alone(ground: AlbumGround, encoder: PhotographEncoder, photograph: AlbumPhotograph) -> Pin:
    height = stated_height(ground.plan, None)
    query = encoder.query(photograph.view, None, height)
    found = localise(
        ground.plan, ground.grid, encoder, query, refiner=refine_walls, config=LocaliseConfig(vdr_candidates=0)
    )
    confidence = found.confidence(encoder.manifest.confidence_for(view=query.is_view))
    fit = 1.0 if confidence is None else confidence.fit
    share = np.bincount(ground.grid.poses.room_index, found.posterior.pose, minlength=len(ground.plan.rooms))
    suggestions = tuple(
        Suggestion(
            pose=ground.pose(candidate.position_m, candidate.room_index, photograph_heading(query, candidate)),
            probability=fit * probability,
        )
        for candidate, probability in zip(found.candidates, found.posterior.candidate, strict=True)
    )[:_SUGGESTIONS]
    room = found.candidates[0].room_index
    sure = fit * float(share[room])
    return Pin(
        photograph_id=photograph.id,
        state="sure" if sure >= SURE else "uncertain",
        pose=suggestions[0].pose,
        confidence=sure,
        within_1m=fit * found.posterior.position if math.isfinite(found.posterior.position) else 0.0,
        rooms=tuple(ground.share(int(index), float(share[index])) for index in np.argsort(-share)[:8]),
        suggestions=suggestions,
    )
