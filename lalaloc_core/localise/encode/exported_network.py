"""Common parts of the exported image encoders: sessions of onnxruntime, outputs, and queries made of outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import onnxruntime
from jaxtyping import Float, Int

from lalaloc_core.bundle import Manifest, ViewManifest
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.localise.query import (
    PredictedCeiling,
    PredictedOpenings,
    PredictedProfile,
    PredictedRoomType,
    Query,
    rolled,
)
from lalaloc_core.localise.query.query import Later

PROFILE_OUTPUTS = ["log_profile", "log_scale"]
# Further output of networks that predict walls as mixtures; the others then have a value for each mode.
SHARE_OUTPUT = "log_share"
STRUCTURE_OUTPUTS = ["opening_logits", "log_ceiling", "log_ceiling_scale", "room_type_logits"]


def open_session(model: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Create a session with a number of intra-op threads, 0 for one per core."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Spinning idle threads would take the cores of the LPO workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def as_array(value: object) -> np.ndarray:
    """Return a network's output, which onnxruntime types as any object, as an array."""
    assert isinstance(value, np.ndarray)
    return value


def turned_predictions(
    outputs: Mapping[str, np.ndarray], shifts: Int[np.ndarray, "k"], trained: Manifest | ViewManifest
) -> dict[str, Any]:
    """Return the predictions of a query, turned to the right by numbers of azimuth columns.

    `outputs` are those of an image encoder by name; without the outputs of the structure, walls alone are predicted.
    `trained` states the frequencies of classes that the probabilities presume.
    """
    predictions: dict[str, Any] = {"profile": PredictedProfile.of_outputs(outputs).moved(shifts)}
    if outputs.keys() >= set(STRUCTURE_OUTPUTS):
        openings = rolled(_log_softmax(outputs["opening_logits"]), shifts)
        predictions["openings"] = PredictedOpenings(openings, np.array(trained.opening_prior))
        ceiling = float(outputs["log_ceiling"]), float(outputs["log_ceiling_scale"])
        predictions["ceiling"] = PredictedCeiling(*ceiling)
        types = _log_softmax(outputs["room_type_logits"])
        predictions["room_type"] = PredictedRoomType(types, np.array(trained.room_type_prior))
    return predictions


def query_of_hypotheses(
    hypotheses: Callable[[Int[np.ndarray, "k"]], Query],
    count: int,
    heading: float | None,
    tolerance: float,
    rest: float | None = None,
) -> Query:
    """Return the query of a photograph with a hypothesis for every heading that is possible.

    Args:
        hypotheses: returns the query with an unknown heading for turns to the right, in steps.
        count: steps of a full turn.
        heading: azimuth of the photograph's centre (radians); None if unknown, with a hypothesis for each step.
        tolerance: largest error of the heading (radians); if it is not 0, the heading is refined.
        rest: heading (radians) that is left after the picture was rolled; None turns the outputs instead, by steps.
    """
    if heading is None:
        return hypotheses(np.arange(count))
    shift = 0
    if rest is None:
        shift = round(heading / (TWO_PI / count))
        rest = float(wrap_angle(heading - shift * (TWO_PI / count)))
    farthest = min(math.ceil(tolerance / TWO_PI * count), (count - 1) // 2)
    query = hypotheses(shift + np.arange(-farthest, farthest + 1))
    searched = None if query.profile is None else Later(partial(hypotheses, np.arange(count)))
    return replace(query, frame_heading=rest, heading_known=tolerance == 0.0, searched=searched)


def _log_softmax(logits: Float[np.ndarray, "*n c"]) -> Float[np.ndarray, "*n c"]:
    """Return the logs of the probabilities of classes."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
