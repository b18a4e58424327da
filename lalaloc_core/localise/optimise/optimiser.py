"""Optimisers: from a refinement job to refined poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.localise.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.localise.optimise.descent import adam, levenberg_marquardt
from lalaloc_core.localise.optimise.problem import Embedding, LpoConfig, Norm, Problem
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.nets import LayoutEncoder, load_layout_encoder
from lalaloc_core.nets.layout_encoder import RingLayoutEncoder
from lalaloc_core.render.profile import wall_profile


class PoseOptimiser:
    """Optimiser that minimises the distance of embedded layouts to their targets."""

    def __init__(
        self,
        embedding: Embedding | None,
        columns: int,
        *,
        norm: Norm = "l2",
        config: LpoConfig | None = None,
        device: torch.device | None = None,
    ) -> None:
        """Set the embedding and the norm.

        `embedding` maps layouts with this many azimuth `columns` to what is compared with a job's targets (None: the
        log wall profile itself); `norm` is the distance that is minimised. The default device is the CPU.

        Raises:
            ConfigError: Levenberg-Marquardt with absolute differences.
        """
        self.config = config or LpoConfig()
        if norm == "l1" and self.config.method != "adam":
            raise ConfigError(f"optimiser '{self.config.method}' needs a smooth cost; norm '{norm}' needs 'adam'")
        self._embedding = embedding
        self._columns = columns
        self._norm: Norm = norm
        self._device = device or torch.device("cpu")

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Refine every starting pose of a job within its own room, by its `targets` and `precision` alone.

        `cost` and `latent_distance` of the result are distances by this optimiser's norm.
        """
        problem = Problem(self._embedding, self._columns, self._norm, job, self._device)
        descend = adam if self.config.method == "adam" else levenberg_marquardt
        with torch.no_grad():
            pose, here, converged, evaluations = descend(problem, self.config)
        position, heading, height_offset = problem.unpack(pose)
        information = here.information if height_offset is None else _without_last(here.information)
        distance = here.distance.cpu().numpy()
        return RefinementResult(
            position_m=position.cpu().numpy().astype(np.float64) + problem.origin,
            heading=heading.cpu().numpy().astype(np.float64),
            cost=distance,
            latent_distance=distance,
            information=information.cpu().numpy(),
            converged=converged.cpu().numpy(),
            evaluations=np.full(len(distance), evaluations),
            height_offset=None if height_offset is None else height_offset.cpu().numpy().astype(np.float64),
        )


class PoseRefiner:
    """Refiner with one layout encoder; it compares wall profiles if a job has predicted ones."""

    def __init__(self, layout_encoder: LayoutEncoder, config: LpoConfig | None = None) -> None:
        layout_encoder = layout_encoder.eval().requires_grad_(False)
        self.encoder = layout_encoder.fused() if isinstance(layout_encoder, RingLayoutEncoder) else layout_encoder
        self._device = next(layout_encoder.parameters()).device
        self._config = config or LpoConfig()
        self._columns = self.encoder.config.profile_columns

    @classmethod
    def from_bundle(cls, bundle: Bundle, config: LpoConfig | None = None) -> PoseRefiner:
        """Load the layout encoder of a bundle.

        Raises:
            BundleError: weights are missing, altered, or do not fit the manifest's configuration.
        """
        manifest = bundle.manifest
        try:
            encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
        except (RuntimeError, ValueError, TypeError) as error:
            raise BundleError(f"bundle '{bundle.folder}': layout encoder does not load: {error}") from error
        return cls(encoder, config)

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Refine every starting pose of a job within its own room, by wall profiles if it has them, else by latents."""
        if job.log_profile is None or job.precision is None:
            return self._optimiser(self.encoder, "l2").refine(replace(job, precision=None))
        by_profile = replace(job, targets=job.log_profile)
        result = self._optimiser(None, "cauchy").refine(by_profile)
        if not job.latent_weight:
            return replace(result, latent_distance=None)
        distance = self._latent_distance(job, result)
        return replace(result, cost=result.cost + job.latent_weight * distance, latent_distance=distance)

    def _optimiser(self, embedding: Embedding | None, norm: Norm) -> PoseOptimiser:
        return PoseOptimiser(embedding, self._columns, norm=norm, config=self._config, device=self._device)

    @torch.no_grad()
    def _latent_distance(self, job: RefinementJob, result: RefinementResult) -> Float[np.ndarray, "k"]:
        """Return the distances of the refined poses' latents to the query's."""

        def tensor(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=self._device)

        relative = tensor(job.walls_m - np.tile(result.position_m, 2)[:, None, :])
        profile = wall_profile(torch.zeros_like(relative[:, 0, :2]), tensor(result.heading), relative, self._columns)
        latent = self.encoder(profile, tensor(job.camera_height_m), tensor(job.ceiling_height_m))
        return torch.linalg.vector_norm(latent - tensor(job.targets), dim=1).cpu().numpy()


def _without_last(information: Float[Tensor, "k p p"]) -> Float[Tensor, "k q q"]:
    """Return the information about all unknowns but the last, which is integrated out (Schur complement)."""
    cross, last = information[:, :-1, -1], information[:, -1, -1].clamp_min(1e-9)
    return information[:, :-1, :-1] - cross[:, :, None] * cross[:, None, :] / last[:, None, None]
