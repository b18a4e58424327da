"""VDR + Decode: the decoded layout leads to its pose; retrieval and VDR equal LaLaLoc's."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lalaloc_core.evaluate.methods.decode import VdrDecode
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.pipeline import LocaliseConfig
from lalaloc_core.nets.decoder import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder
from lalaloc_core.render.depth import layout_depth
from tests.core.questions import CAMERA_M, question_at
from tests.core.test_headings import COLUMNS
from tests.strategies import crooked_flat, plan_of


class TrueDecoder(LayoutDecoder):
    """Stub of a perfect decoder: the layout depth of the true pose for every latent."""

    def __init__(self, question: Question) -> None:
        super().__init__()
        camera, ceiling = np.array([CAMERA_M]), np.array([question.ceiling_height_m])
        self.depth = layout_depth(question.true_profile(COLUMNS)[None], camera, ceiling, DECODED_HEIGHT)

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        depth = torch.from_numpy(self.depth.astype(np.float32)).expand(len(latent), -1, -1)
        return depth.repeat_interleave(DECODED_WIDTH // depth.shape[2], dim=2)


@pytest.mark.parametrize("position", [(1.4, 1.3), (2.1, 0.9), (3.1, 1.6)])
def test_perfect_decoder_finds_the_truth(encoders: Encoders, position: tuple[float, float]) -> None:
    question = question_at(plan_of([[0.0, 0.0], [4.0, 0.0], [4.0, 2.2], [0.0, 3.0]]), position)
    answer = VdrDecode(encoders, TrueDecoder(question)).locate(question)
    found = answer.stages["decode"]
    assert math.hypot(found.x_m - position[0], found.y_m - position[1]) < 0.02
    assert found.distance == pytest.approx(0.0, abs=0.01)
    assert list(answer.timings_ms) == ["encode", "retrieve", "vdr", "decode"]


@pytest.mark.parametrize("heading_known", [True, False])
def test_retrieval_and_vdr_equal_lalaloc(encoders: Encoders, heading_known: bool) -> None:
    torch.manual_seed(0)
    question = question_at(crooked_flat(), (1.2, 1.1), heading=0.7, heading_known=heading_known)
    answer = VdrDecode(encoders, LayoutDecoder()).locate(question)
    by_latent = LocaliseConfig(matching=MatchingConfig(use_profile=False))
    expected = LaLaLoc(encoders, refine="vdr", config=by_latent).locate(question)
    assert list(answer.stages) == ["retrieval", "vdr", "decode"]
    assert {stage: answer.stages[stage] for stage in expected.stages} == expected.stages
    assert answer.retrieved == expected.retrieved
    # The decoder is untrained; the pose still stays in its room.
    found = answer.stages["decode"]
    assert crooked_flat().room_index_at(np.array([[found.x_m, found.y_m]]))[0] == found.room_index
    if heading_known:
        assert found.heading == pytest.approx(0.7)


def test_decoded_layouts_have_the_compared_width(encoders: Encoders) -> None:
    torch.manual_seed(0)
    decoder = LayoutDecoder().eval()
    latents = np.random.default_rng(0).normal(size=(3, 128)).astype(np.float32)
    decoded = VdrDecode(encoders, decoder).decode(latents).reshape(3, DECODED_HEIGHT, COLUMNS)
    with torch.no_grad():
        whole = decoder(torch.from_numpy(latents)).numpy()
    np.testing.assert_allclose(decoded, whole[:, :, :: DECODED_WIDTH // COLUMNS], atol=1e-6)
