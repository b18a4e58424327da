"""A bundle of architecture `paper` is served through all stages: pose grid, retrieval, VDR and LPO on latents."""

from __future__ import annotations

import dataclasses
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.export.bundle_export import export_bundle
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.learn.training.stages import build_image_encoder, build_layout_encoder
from lalaloc_core.nets.paper_encoders import PaperConfig
from tests.service.conftest import FLAT, document_of, localise, localise_turn, upload, wait_for

# Seconds of LPO on the small networks, even on a busy machine.
LPO_DEADLINE_S = 60.0


@pytest.fixture(scope="module")
def app_settings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the settings of an app with one LPO worker, on untrained networks of the paper's architecture."""
    sizes = PaperConfig(width=8, image_depth=18, layout_height=32, profile_columns=64, image_height=64, image_width=128)
    config = dataclasses.replace(PRESETS["paper"], paper=sizes)
    folder = tmp_path_factory.mktemp("paper")
    networks = build_layout_encoder(config), build_image_encoder(config)
    export_bundle(folder, config, *networks, name="paper", version="test")
    return {"bundle": folder, "workers": 1, "lpo_deadline_s": LPO_DEADLINE_S}


@pytest.mark.slow
@pytest.mark.parametrize("heading", [None, 90.0])
@pytest.mark.parametrize(("refine", "stage"), [("none", "retrieval"), ("vdr", "vdr"), ("lpo", "lpo")])
def test_query_reaches_each_stage(
    client: httpx.Client, sphere: bytes, refine: str, stage: str, heading: float | None
) -> None:
    plan_id = upload(client)
    fields = {} if heading is None else {"heading_deg": heading}
    answers: list[dict[str, Any]] = []

    def reached() -> bool:
        answers.append(document_of(localise(client, plan_id, sphere, refine=refine, **fields)))
        return answers[-1]["stage"] == stage

    # LPO falls back to the VDR pose until the worker has started.
    wait_for(reached)
    answer = answers[-1]
    # The cost of a model without wall profiles is the latent distance.
    assert answer["cost"] == pytest.approx(answer["latent_distance"], abs=2e-3)
    plan = FloorPlan.from_dict(FLAT)
    for candidate in answer["candidates"]:
        position = np.array([[candidate["position"]["x_m"], candidate["position"]["y_m"]]])
        assert plan.rooms[int(plan.room_index_at(position)[0])].name == candidate["room"]


@pytest.mark.slow
def test_turn_is_refined_by_latents(client: httpx.Client, sphere: bytes) -> None:
    answer = document_of(localise_turn(client, upload(client), sphere, sphere))
    # The pose on the grid is the answer until the worker has started.
    assert answer["stage"] in ("lpo", "retrieval")
    assert len(answer["poses"]) == 2
