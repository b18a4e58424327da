"""Data set and method of a run, built from its description (`RunInfo`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch

from lalaloc_core.bundle import Bundle
from lalaloc_core.configuration import build_config
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods.explicit import ExplicitLayout, VdrDecode
from lalaloc_core.evaluate.methods.icp import Icp
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, StatedHeight
from lalaloc_core.evaluate.methods.method import Method
from lalaloc_core.evaluate.methods.similarity import LayoutMetric, PoseOracle, SimilarityRetrieval
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.learn.data import Appearance, Dataset, HeldoutScenes, ViewScenes, open_dataset
from lalaloc_core.learn.data.synthetic import GeneratedScenes
from lalaloc_core.learn.data.synthetic.altered_homes import CHANGES, AlteredScenes
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.query import DEFAULT_STD_M
from lalaloc_core.localise.refine import LpoConfig
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.localise.search.pipeline import LocaliseConfig, Refine
from lalaloc_core.nets import load_decoder


@dataclass(frozen=True, kw_only=True)
class LaLaLocSettings:
    """Settings of method "lalaloc"; the defaults are the service's.

    Attributes:
        vdr_candidates, lpo_candidates: number of refined candidates.
        evidence: term of the matching cost for walls: the predicted wall profile, the latent, or the sum of both.
        optimiser: method of LPO.
        openings, ceiling, room_type, see_through: whether the matching cost has these terms, if model and plan do.
        heading_doubt: assumed probability that a known heading is wrong.
        camera_height: whether the camera's height is stated, with `camera_height_std_m`, or unknown.
        camera_height_error_m: error added to the stated height.
        heading_error_deg: largest error of the known heading of views, which is searched within it.
    """

    refine: Refine = "lpo"
    vdr_samples: int = 200
    vdr_candidates: int = 1
    lpo_candidates: int = 5
    evidence: Literal["profile", "latent", "both"] = "profile"
    optimiser: Literal["levenberg-marquardt", "adam"] = "levenberg-marquardt"
    openings: bool = True
    ceiling: bool = True
    room_type: bool = True
    see_through: bool = True
    heading_doubt: float = MatchingConfig.heading_doubt
    camera_height: Literal["stated", "unknown"] = "stated"
    camera_height_std_m: float = DEFAULT_STD_M
    camera_height_error_m: float = 0.0
    heading_error_deg: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SimilaritySettings:
    """Settings of method "similarity": the metric of layouts."""

    metric: LayoutMetric = "chamfer"


@dataclass(frozen=True, kw_only=True)
class NoSettings:
    """Settings of methods without settings."""


_Settings = TypeVar("_Settings")


def build_dataset(info: RunInfo) -> Dataset:
    """Return the data set of a run."""
    spheres = _spheres(info)
    return spheres if info.views is None else ViewScenes(spheres, **info.views)


def _spheres(info: RunInfo) -> Dataset:
    if info.data is not None:
        return open_dataset(Path(info.data), info.data_format)
    arguments: dict[str, Any] = dict(info.generated or {})
    generator = arguments.pop("generator", "synth")
    if generator == "heldout":
        # Runs of up to 0.11 state the seed and furniture of a generator.
        if arguments.pop("seed", 0) != 0 or arguments.pop("furniture", "full") != "full":
            raise InvalidInputError("the out-of-distribution homes are furnished ones of seed 0")
        return HeldoutScenes(**arguments)
    if arguments.get("textures") is not None:
        arguments["textures"] = Path(arguments["textures"])
    homes = GeneratedScenes(**arguments)
    return AlteredScenes(homes, generator) if generator in CHANGES else homes


_WITHOUT_MODEL: dict[str, Callable[[], Method]] = {"oracle": SimilarityRetrieval, "pose-oracle": PoseOracle, "icp": Icp}


def build_method(info: RunInfo) -> Method:
    """Return the method of a run, on one thread."""
    if info.method == "similarity":
        return SimilarityRetrieval(_settings(SimilaritySettings, info).metric)
    settings = _settings(LaLaLocSettings if info.method == "lalaloc" else NoSettings, info)
    if info.method in _WITHOUT_MODEL:
        return _WITHOUT_MODEL[info.method]()
    bundle = require_bundle(info)
    encoders = PhotographEncoder(bundle, threads=1)
    # Tensors of a few poses are too small for several threads.
    torch.set_num_threads(1)
    if info.method == "explicit":
        return ExplicitLayout(encoders)
    if info.method == "decode":
        return VdrDecode(encoders, load_decoder(bundle))
    assert isinstance(settings, LaLaLocSettings)
    return _lalaloc(bundle, encoders, settings)


def _lalaloc(bundle: Bundle, encoders: PhotographEncoder, settings: LaLaLocSettings) -> LaLaLoc:
    refiner = None
    if settings.refine == "lpo":
        refiner = PoseRefiner.from_bundle(bundle, LpoConfig(method=settings.optimiser)).refine
    config = LocaliseConfig(
        vdr_samples=settings.vdr_samples,
        vdr_candidates=settings.vdr_candidates,
        lpo_candidates=settings.lpo_candidates,
        matching=MatchingConfig(
            use_profile=settings.evidence != "latent",
            latent_weight=1.0 if settings.evidence == "both" else 0.0,
            use_openings=settings.openings,
            use_ceiling=settings.ceiling,
            use_room_type=settings.room_type,
            use_see_through=settings.see_through,
            heading_doubt=settings.heading_doubt,
        ),
    )
    stated = StatedHeight(
        is_known=settings.camera_height == "stated",
        error_m=settings.camera_height_error_m,
        std_m=settings.camera_height_std_m,
    )
    return LaLaLoc(
        encoders,
        refine=settings.refine,
        refiner=refiner,
        config=config,
        stated=stated,
        heading_error_deg=settings.heading_error_deg,
    )


def _settings(kind: type[_Settings], info: RunInfo) -> _Settings:
    return build_config(kind, info.settings, path=f"settings of method '{info.method}'")


def require_bundle(info: RunInfo) -> Bundle:
    """Return the bundle of a run."""
    if info.bundle is None:
        raise InvalidInputError(f"method '{info.method}' needs a model bundle; name its folder with --bundle")
    return Bundle.open(Path(info.bundle))


def describe_model(folder: Path) -> dict[str, str]:
    """Return name, version and SHA-256 of a model."""
    bundle = Bundle.open(folder)
    return {"name": bundle.manifest.name, "version": bundle.manifest.version, "sha256": bundle.sha256}


def choose_appearance(dataset: Dataset, furniture: str | None, lighting: str | None) -> Appearance:
    """Return the appearance of a run's photographs; the data set's default for None."""
    default = dataset.appearances[0]
    appearance = Appearance(furniture or default.furniture, lighting or default.lighting)
    if appearance not in dataset.appearances:
        known = ", ".join(map(str, dataset.appearances))
        raise InvalidInputError(f"{dataset.description} has no photographs '{appearance}'; choose one of: {known}")
    return appearance
