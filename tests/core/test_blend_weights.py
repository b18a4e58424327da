"""Weights between two of one network."""

from __future__ import annotations

import pytest
import torch

from lalaloc_core.errors import InvalidInputError
from scripts.blend_weights import blended

EARLIER = {"weight": torch.tensor([0.0, 4.0], dtype=torch.float16), "count": torch.tensor(3)}
LATER = {"weight": torch.tensor([2.0, 0.0]), "count": torch.tensor(8)}


def test_weights_lie_between_both_and_counts_are_the_later_ones() -> None:
    between = blended(LATER, EARLIER, 0.25)
    torch.testing.assert_close(between["weight"], torch.tensor([0.5, 3.0]))
    assert between["count"] == 8
    torch.testing.assert_close(blended(LATER, EARLIER, 1.0)["weight"], LATER["weight"])


@pytest.mark.parametrize(
    ("earlier", "share", "message"),
    [(EARLIER, 1.5, "the share is 1.5"), ({"weight": torch.zeros(3), "count": torch.tensor(0)}, 0.5, "same network")],
)
def test_what_cannot_be_blended_is_refused(earlier: dict[str, torch.Tensor], share: float, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        blended(LATER, earlier, share)
