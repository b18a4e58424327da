"""Benchmark of walls and openings by azimuth."""

from __future__ import annotations

import numpy as np
import pytest

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.evaluate.bench.azimuths import azimuth_figures
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.localise.bundle import Bundle, default_bundle
from lalaloc_core.localise.encoders import Encoders


def test_figures_cover_every_panorama_and_azimuth() -> None:
    encoders = Encoders(Bundle.open(default_bundle()), threads=1)
    figures = azimuth_figures(encoders, GeneratedScenes(homes=1, shots_per_home=3))
    assert figures["n"] == 3
    assert figures["median_error"] < 0.2
    recall, confusion = figures["classes"]["recall"], figures["confusion"]
    for kind in OPENING_CLASSES:
        assert confusion[kind][kind] == pytest.approx(recall[kind] or 0.0)
        assert sum(confusion[kind].values()) == pytest.approx(float(recall[kind] is not None))
    known = [share for share in recall.values() if share is not None]
    assert figures["classes"]["balanced_accuracy"] == pytest.approx(np.mean(known))
    assert figures["classes"]["balanced_accuracy"] > 0.4
