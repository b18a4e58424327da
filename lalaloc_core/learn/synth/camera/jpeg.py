"""Losses of JPEG compression: 8 x 8 cosine blocks, quantised by the tables of ITU T.81, annex K."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

_BLOCK = 8
_LUMA = (
    *(16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29),
    *(51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121),
    *(120, 101, 72, 92, 95, 98, 112, 100, 103, 99),
)
_CHROMA = (
    *(17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66),
    *((99,) * 38),
)
# From RGB to luma and two differences of colour.
_TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))


def compress(picture: Float[Tensor, "b h w 3"], quality: Float[Tensor, "b"]) -> Float[Tensor, "b h w 3"]:
    """Compress pictures in 0..1 at a `quality` of 1 to 100, without chroma sub-sampling."""
    rows, columns = picture.shape[1:3]
    matrix = picture.new_tensor(_TO_YCC)
    planes = (picture * 255.0 - 128.0) @ matrix.T
    planes = torch.nn.functional.pad(
        planes.permute(0, 3, 1, 2), (0, -columns % _BLOCK, 0, -rows % _BLOCK), mode="replicate"
    )
    blocks = planes.unflatten(3, (-1, _BLOCK)).unflatten(2, (-1, _BLOCK)).transpose(3, 4)
    # One product of (64, 64) for both axes at once is faster than two small ones for every block.
    cosines = _cosines(picture)
    steps = _steps(picture, quality).flatten(2)[:, :, None, None]
    rounded = (blocks.flatten(4) @ cosines.T).div_(steps).round_().mul_(steps)
    planes = (rounded @ cosines).unflatten(4, (_BLOCK, _BLOCK)).transpose(3, 4).flatten(4, 5).flatten(2, 3)
    planes = planes[:, :, :rows, :columns].permute(0, 2, 3, 1)
    return ((planes @ torch.linalg.inv(matrix).T + 128.0) / 255.0).clamp_(0.0, 1.0)


def _cosines(like: Tensor) -> Float[Tensor, "64 64"]:
    """Return the orthonormal discrete cosine transform of flattened blocks."""
    k = torch.arange(_BLOCK, device=like.device, dtype=like.dtype)
    table = torch.cos((k[None] + 0.5) * k[:, None] * (math.pi / _BLOCK)) * math.sqrt(2.0 / _BLOCK)
    table[0] *= math.sqrt(0.5)
    return torch.kron(table, table)


def _steps(like: Tensor, quality: Float[Tensor, "b"]) -> Float[Tensor, "b 3 8 8"]:
    scale = torch.where(quality < 50.0, 5000.0 / quality.clamp(min=1.0), 200.0 - 2.0 * quality)
    tables = like.new_tensor([_LUMA, _CHROMA, _CHROMA]).reshape(3, _BLOCK, _BLOCK)
    return ((tables * scale[:, None, None, None] + 50.0) / 100.0).floor().clamp(min=1.0)
