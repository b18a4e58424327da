"""Exported classifier of objects on onnxruntime: objects of photographs, and the types of rooms that they suggest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.bundle import OBJECTS_ONNX, Bundle, ObjectsManifest
from lalaloc_core.localise.encode.exported_network import as_array, open_session
from lalaloc_core.localise.query import PredictedRoomType, SeenObject, SeenObjects
from lalaloc_core.photograph import Photograph

OBJECT_OUTPUTS = ("object_probability", "object_azimuth")
# Least probability of objects that are named, and a probability whose log is finite.
_LEAST, _NEVER = 0.1, 1e-9
# Probability of all objects together, which are those of households, and the log likelihood ratio of outside to inside:
# of 32 real photographs outside (12 of streets, façades and woods), and of 122 real and 220 rendered views of rooms.
_HOUSEHOLD, _OUTSIDE = (0.02, 0.035, 0.05, 0.07, 0.09, 0.12, 0.2), (5.0, 4.2, 3.0, 1.5, 0.5, -1.5, -3.0)


class ObjectEncoder:
    """Classifier of objects of one bundle, ready to run; safe to share between threads."""

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        """Create the onnxruntime session, with `threads` intra-op threads, 0 for one per core.

        Raises:
            BundleError: the bundle has no classifier of objects, or its file is altered.
        """
        self._session = open_session(bundle.read(OBJECTS_ONNX), threads)

    def outputs(self, photograph: Photograph) -> dict[str, Float[np.ndarray, "n"]]:
        """Return the probability of each object, and its azimuth (radians) relative to the photograph's centre.

        The photograph has a thumbnail, a camera and axes.
        """
        thumbnail = photograph.thumbnail
        assert thumbnail is not None
        probability, by_column = map(
            as_array, self._session.run(["probability", "by_column"], {"image": thumbnail[None]})
        )
        return {
            "object_probability": probability[0],
            "object_azimuth": _column_azimuths(photograph, by_column.shape[2])[by_column[0].argmax(axis=1)],
        }

    def warm_up(self) -> None:
        """Run the network once, because the first run allocates memory."""
        image: UInt8[np.ndarray, "1 h w 3"] = np.zeros((1, 256, 320, 3), np.uint8)
        self._session.run(["probability"], {"image": image})


def seen_objects(
    manifest: ObjectsManifest, views: Sequence[tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
) -> SeenObjects:
    """Return what the photographs of one spot show.

    `views` are the probabilities of the objects in each photograph, and their azimuths (radians) relative to the centre
    of the first one.
    """
    probability = np.stack([share for share, _ in views])
    score = probability.mean(axis=0) @ np.array(manifest.shares) + manifest.floor
    # Objects are never those of the unknown type.
    score[0] = _NEVER
    room_type = PredictedRoomType(np.log(score / score.sum()), np.full(len(score), 1.0 / (len(score) - 1)))
    best = probability.argmax(axis=0)
    named = [number for number in np.argsort(-probability.max(axis=0)) if probability[best[number], number] >= _LEAST]
    objects = tuple(
        SeenObject(
            manifest.names[number], float(probability[best[number], number]), float(views[best[number]][1][number])
        )
        for number in named
    )
    return SeenObjects(room_type, objects, min(outside_odds(share) for share in probability))


def outside_odds(probability: Float[np.ndarray, "n"]) -> float:
    """Return the log likelihood ratio of a photograph taken outside to one of a room, by what its objects are."""
    return float(np.interp(probability.sum(), _HOUSEHOLD, _OUTSIDE))


def _column_azimuths(photograph: Photograph, columns: int) -> Float[np.ndarray, "columns"]:
    """Return the azimuth (radians) of the middle of each column of the photograph, relative to its centre."""
    camera, axes = photograph.camera, photograph.axes
    assert camera is not None
    assert axes is not None
    x = (np.arange(columns) + 0.5) / columns * camera.width
    rays = camera.rays(np.stack([x, np.full(columns, 0.5 * camera.height)], axis=1)) @ axes
    return np.arctan2(rays[:, 0], rays[:, 1])
