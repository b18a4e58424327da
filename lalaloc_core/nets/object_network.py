"""Classifier of objects that tell the type of a room: its network, and the types that objects suggest.

`objects.toml` has the classes with the types, those of the detector (`detector_network.py`) too.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.nets.trunk import IMAGE_MEAN, IMAGE_STD, Trunk, TrunkConfig, load_pretrained, pretrained_weights

# Channels of the last convolution, and epsilon of its normalisation.
_HEAD_CHANNELS, _NORM_EPSILON = 1280, 1e-3


class ObjectNetwork(nn.Module):
    """EfficientNet-Lite0 with its pretrained classifier, for those of the 1,000 ImageNet classes that are `OBJECTS`."""

    def __init__(self) -> None:
        super().__init__()
        self._trunk = Trunk(TrunkConfig(), circular=False)
        load_pretrained(self._trunk)
        weights = pretrained_weights()
        scale = weights["_bn1.weight"] * torch.rsqrt(weights["_bn1.running_var"] + _NORM_EPSILON)
        outputs, inputs = weights["_fc.weight"].shape[0], self._trunk.config.widths[-1]
        self._head = nn.Conv2d(inputs, _HEAD_CHANNELS, 1)
        self._head.weight.data = weights["_conv_head.weight"] * scale[:, None, None, None]
        self._head.bias = nn.Parameter(weights["_bn1.bias"] - weights["_bn1.running_mean"] * scale)
        self._classifier = nn.Linear(_HEAD_CHANNELS, outputs)
        self._classifier.weight.data, self._classifier.bias.data = weights["_fc.weight"], weights["_fc.bias"]
        self.register_buffer("_classes", torch.tensor([number for _, number, _ in OBJECTS]), persistent=False)
        self._classes: Tensor
        self.register_buffer("_mean", 255.0 * torch.tensor(IMAGE_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("_std", 255.0 * torch.tensor(IMAGE_STD).view(3, 1, 1), persistent=False)
        self._mean: Tensor
        self._std: Tensor

    def forward(self, image: UInt8[Tensor, "b h w 3"]) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n v"]]:
        """Return the probability of each object in RGB pictures, and by column the largest one near any of its rows.

        Columns are `TAP_STRIDES[-1]` pixels wide.
        """
        pixels = (image.permute(0, 3, 1, 2).to(self._mean.dtype) - self._mean) / self._std
        features = functional.relu6(self._head(self._trunk(pixels)[-1]))
        probability = torch.softmax(self._classifier(features.mean(dim=(2, 3))), dim=1)
        around = functional.avg_pool2d(features, 3, 1, 1, count_include_pad=False)
        local = torch.softmax(self._classifier(around.permute(0, 2, 3, 1)), dim=3)
        by_column = local.index_select(3, self._classes).amax(dim=1).transpose(1, 2)
        return probability.index_select(1, self._classes), by_column


_TABLE = tomllib.loads(Path(__file__).with_name("objects.toml").read_text(encoding="utf-8"))
# Name, class, and the types of rooms that have such an object, with shares that sum to 1: objects that a classifier
# recognises (ImageNet), and those that a detector finds (COCO).
Objects = tuple[tuple[str, int, dict[str, float]], ...]


def _objects(table: str) -> Objects:
    return tuple(
        (name, row["class"], {kind: share for kind, share in row.items() if kind != "class"})
        for name, row in _TABLE[table].items()
    )


OBJECTS, DETECTED = _objects("recognised"), _objects("detected")
# Rooms of a type (first) that are open to those of another, with the share of these whose objects they also show.
_OPEN: tuple[tuple[str, str, float], ...] = (
    ("living", "kitchen", 0.2),
    ("living", "dining", 0.4),
    ("dining", "kitchen", 0.3),
    ("dining", "living", 0.3),
    ("kitchen", "dining", 0.4),
    ("kitchen", "living", 0.1),
    ("meeting", "office", 0.3),
    ("corridor", "stairs", 0.3),
    ("entrance", "stairs", 0.3),
)


def shares_by_type(objects: Objects) -> Float[np.ndarray, "n t"]:
    """Return the share of every object (row) that a room of each type, in the order of `ROOM_TYPES`, accounts for."""
    open_to = np.eye(len(ROOM_TYPES))
    for kind, other, share in _OPEN:
        open_to[ROOM_TYPES.index(other), ROOM_TYPES.index(kind)] = share
    shares = np.array([[kinds.get(kind, 0.0) for kind in ROOM_TYPES] for _, _, kinds in objects])
    return shares @ open_to
