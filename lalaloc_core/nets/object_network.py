"""Classifier of objects that tell the type of a room: its network, their classes, and the types that they suggest.

The shares are common knowledge, written down before any result was seen; none is fitted.
"""

from __future__ import annotations

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


# Name, ImageNet class, and the types of rooms that have such an object, with shares that sum to 1.
_KITCHEN, _BATHROOM, _OFFICE = {"kitchen": 1.0}, {"bathroom": 1.0}, {"office": 0.7, "living": 0.15, "bedroom": 0.15}
_SCREEN, _GARAGE = {"living": 0.8, "bedroom": 0.2}, {"garage": 1.0}
OBJECTS: tuple[tuple[str, int, dict[str, float]], ...] = (
    ("four-poster bed", 564, {"bedroom": 1.0}),
    ("quilt", 750, {"bedroom": 1.0}),
    ("pillows", 721, {"bedroom": 0.7, "living": 0.3}),
    ("crib", 520, {"bedroom": 1.0}),
    ("bassinet", 431, {"bedroom": 1.0}),
    ("cradle", 516, {"bedroom": 1.0}),
    ("wardrobe", 894, {"bedroom": 0.7, "closet": 0.1, "corridor": 0.1, "entrance": 0.1}),
    ("couch", 831, {"living": 0.6, "bedroom": 0.4}),
    ("television", 851, _SCREEN),
    ("home cinema", 598, _SCREEN),
    ("television cabinet", 548, _SCREEN),
    ("fireplace screen", 556, {"living": 1.0}),
    ("rocking chair", 765, {"living": 0.7, "bedroom": 0.3}),
    ("bookcase", 453, {"living": 0.6, "office": 0.4}),
    ("library", 624, {"living": 0.5, "office": 0.5}),
    ("dining table", 532, {"dining": 0.7, "kitchen": 0.15, "living": 0.15}),
    ("restaurant", 762, {"dining": 1.0}),
    ("china cabinet", 495, {"dining": 0.5, "kitchen": 0.5}),
    ("stove", 827, _KITCHEN),
    ("microwave", 651, _KITCHEN),
    ("refrigerator", 760, _KITCHEN),
    ("dishwasher", 534, _KITCHEN),
    ("espresso maker", 550, _KITCHEN),
    ("coffee pot", 505, _KITCHEN),
    ("plate rack", 729, _KITCHEN),
    ("toaster", 859, _KITCHEN),
    ("waffle iron", 891, _KITCHEN),
    ("dutch oven", 544, _KITCHEN),
    ("slow cooker", 521, _KITCHEN),
    ("cauldron", 469, _KITCHEN),
    ("wok", 909, _KITCHEN),
    ("frying pan", 567, _KITCHEN),
    ("rotisserie", 766, _KITCHEN),
    ("spatula", 813, _KITCHEN),
    ("mixing bowl", 659, _KITCHEN),
    ("teapot", 849, _KITCHEN),
    ("bathtub", 435, _BATHROOM),
    ("tub", 876, _BATHROOM),
    ("toilet seat", 861, _BATHROOM),
    ("washbasin", 896, _BATHROOM),
    ("shower curtain", 794, _BATHROOM),
    ("medicine cabinet", 648, _BATHROOM),
    ("soap dispenser", 804, _BATHROOM),
    ("toilet paper", 999, _BATHROOM),
    ("bath towel", 434, _BATHROOM),
    ("shower cap", 793, _BATHROOM),
    ("hair dryer", 589, _BATHROOM),
    ("plunger", 731, _BATHROOM),
    ("washing machine", 897, {"laundry": 0.5, "bathroom": 0.25, "kitchen": 0.25}),
    ("iron", 606, {"laundry": 1.0}),
    ("desk", 526, _OFFICE),
    ("desktop computer", 527, _OFFICE),
    ("monitor", 664, _OFFICE),
    ("screen", 782, _OFFICE),
    ("notebook", 681, _OFFICE),
    ("printer", 742, _OFFICE),
    ("filing cabinet", 553, {"office": 1.0}),
    ("banister", 421, {"stairs": 0.7, "corridor": 0.3}),
    ("doormat", 539, {"entrance": 0.7, "corridor": 0.3}),
    ("patio", 706, {"balcony": 1.0}),
    ("car wheel", 479, _GARAGE),
    ("minivan", 656, _GARAGE),
    ("sports car", 817, _GARAGE),
)
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


def shares_by_type() -> Float[np.ndarray, "n t"]:
    """Return the share of every object (row) that a room of each type, in the order of `ROOM_TYPES`, accounts for."""
    open_to = np.eye(len(ROOM_TYPES))
    for kind, other, share in _OPEN:
        open_to[ROOM_TYPES.index(other), ROOM_TYPES.index(kind)] = share
    shares = np.array([[kinds.get(kind, 0.0) for kind in ROOM_TYPES] for _, _, kinds in OBJECTS])
    return shares @ open_to
