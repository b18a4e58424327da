"""Architecture `paper`: ResNet-18 on layout depth, ResNet-50 on RGB, average pool, one FC to 128 (section A.1.1).

The paper's alternatives are options: ResNet-50 and a two-layer predictor for layouts. Parameter names are
torchvision's, so its ImageNet weights load into `backbone` unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.render.profile import layout_depth

# ImageNet statistics, for training from its weights.
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """Sizes of the `paper` architecture; ResNets have a `width` of 64, which each later stage doubles."""

    layout_depth: Literal[18, 50] = 18
    layout_predictor: Literal["fc", "mlp"] = "fc"
    image_depth: Literal[18, 50] = 50
    width: int = 64
    latent_size: int = 128
    layout_height: int = 128
    profile_columns: int = 256
    image_height: int = 256
    image_width: int = 512


class BasicBlock(nn.Module):
    """Residual block of two 3x3 convolutions (ResNet-18)."""

    expansion = 1

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(inputs, width, stride)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o g v"]:
        """Apply the block."""
        y = functional.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        return functional.relu(y + (x if self.downsample is None else self.downsample(x)))


class Bottleneck(nn.Module):
    """Residual block of 1x1, 3x3 and 1x1 convolutions (ResNet-50)."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = _shortcut(inputs, 4 * width, stride)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o g v"]:
        """Apply the block."""
        y = functional.relu(self.bn1(self.conv1(x)))
        y = functional.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return functional.relu(y + (x if self.downsample is None else self.downsample(x)))


def _shortcut(inputs: int, outputs: int, stride: int) -> nn.Sequential | None:
    if inputs == outputs and stride == 1:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


class ResNet(nn.Module):
    """ResNet-18 or ResNet-50 up to its `channels` pooled features."""

    def __init__(self, depth: int, *, inputs: int = 3, width: int = 64) -> None:
        super().__init__()
        block, counts = {18: (BasicBlock, (2, 2, 2, 2)), 50: (Bottleneck, (3, 4, 6, 3))}[depth]
        self.conv1 = nn.Conv2d(inputs, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.channels = width
        self.layer1 = self._stage(block, width, counts[0], 1)
        self.layer2 = self._stage(block, 2 * width, counts[1], 2)
        self.layer3 = self._stage(block, 4 * width, counts[2], 2)
        self.layer4 = self._stage(block, 8 * width, counts[3], 2)

    def _stage(self, block: type[BasicBlock | Bottleneck], width: int, count: int, stride: int) -> nn.Sequential:
        layers = []
        for index in range(count):
            layers.append(block(self.channels, width, stride if index == 0 else 1))
            self.channels = width * block.expansion
        return nn.Sequential(*layers)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b c"]:
        """Return the pooled features."""
        x = self.maxpool(functional.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return x.mean(dim=(2, 3))


class PaperLayoutEncoder(nn.Module):
    """Layout encoder: layout depth, rendered from the wall profile, to a latent."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = ResNet(config.layout_depth, inputs=1, width=config.width)
        channels = self.backbone.channels
        self.fc: nn.Module = nn.Linear(channels, config.latent_size)
        if config.layout_predictor == "mlp":
            self.fc = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), self.fc)

    def forward(
        self, profile_m: Float[Tensor, "b w"], camera_height_m: Float[Tensor, "b"], ceiling_height_m: Float[Tensor, "b"]
    ) -> Float[Tensor, "b d"]:
        """Encode layouts as latents."""
        depth = layout_depth(profile_m, camera_height_m, ceiling_height_m, self.config.layout_height)
        return functional.normalize(self.fc(self.backbone(depth[:, None])), dim=1)


class PaperImageEncoder(nn.Module):
    """Image encoder: RGB sphere to a latent."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = ResNet(config.image_depth, width=config.width)
        self.fc = nn.Linear(self.backbone.channels, config.latent_size)
        # Not "mean": ONNX would confuse it with the output of the pooling.
        self.register_buffer("pixel_mean", 255.0 * torch.tensor(IMAGE_MEAN)[None, :, None, None], persistent=False)
        self.register_buffer("pixel_std", 255.0 * torch.tensor(IMAGE_STD)[None, :, None, None], persistent=False)
        self.pixel_mean: Tensor
        self.pixel_std: Tensor

    def forward(self, image: Tensor) -> Float[Tensor, "b d"]:
        """Encode `image`, (b, h, w, 3), values 0 to 255 of any type."""
        pixels = (image.permute(0, 3, 1, 2).to(self.pixel_mean.dtype) - self.pixel_mean) / self.pixel_std
        return functional.normalize(self.fc(self.backbone(pixels)), dim=1)
