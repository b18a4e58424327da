"""Refinement by latents on torch: from a refinement job to refined poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.localise.refine.descent_methods import descend, refine_walls
from lalaloc_core.localise.refine.refinement_problem import LpoConfig, Norm, Problem, RefinementJob, RefinementResult
from lalaloc_core.nets import LayoutNetwork, RingLayoutEncoder, load_layout_encoder
from lalaloc_core.render.profile import ProfileJacobian, wall_profile

# Function of wall profiles (k, columns), camera and ceiling heights (k,), compared with the targets (k, d).
_Embedding = Callable[[Tensor, Tensor, Tensor], Tensor]


class PoseOptimiser:
    """Optimiser that minimises the distance of embedded layouts to their targets."""

    def __init__(
        self,
        embedding: _Embedding,
        columns: int,
        *,
        norm: Norm = "l2",
        config: LpoConfig | None = None,
        device: torch.device | None = None,
    ) -> None:
        """Set the embedding and the norm.

        `embedding` maps layouts with this many azimuth `columns` to what is compared with a job's targets; `norm` is
        the distance that is minimised. The default device is the CPU.

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
        problem = _EmbeddedProblem(self._embedding, self._columns, self._norm, job, self._device)
        with torch.no_grad():
            result = descend(problem, self.config)
        # Without a time limit there is always a result.
        assert result is not None
        return result


class _EmbeddedProblem(Problem):
    """Residuals of embedded layouts, differentiated in forward mode."""

    def __init__(
        self, embedding: _Embedding, columns: int, norm: Norm, job: RefinementJob, device: torch.device
    ) -> None:
        super().__init__(columns, norm, job, torch.empty(0, device=device))
        self._embedding = embedding
        self._camera_height_m = torch.as_tensor(job.camera_height_m, dtype=torch.float32, device=device)
        self._ceiling_height_m = torch.as_tensor(job.ceiling_height_m, dtype=torch.float32, device=device)

    @property
    def pose_arrays(self) -> tuple[str, ...]:
        return (*super().pose_arrays, "_camera_height_m", "_ceiling_height_m")

    def embedded(self, layout: ProfileJacobian) -> tuple[Float[Tensor, "k d"], Float[Tensor, "k m d"]]:
        by_pose = layout.by_pose[:, : self._moving]
        profile_m = layout.log_m.exp()
        count = len(profile_m)

        def repeat(value: Tensor) -> Tensor:
            return value.repeat_interleave(self._moving, dim=0)

        camera, ceiling = repeat(self._camera_height_m), repeat(self._ceiling_height_m)
        embedding = self._embedding
        tangent = (by_pose * profile_m[:, None]).flatten(0, 1)
        value, derivative = torch.func.jvp(
            lambda profile: embedding(profile, camera, ceiling), (repeat(profile_m),), (tangent,)
        )[:2]
        return value[:: self._moving], derivative.reshape(count, self._moving, -1)


class PoseRefiner:
    """Refiner with one layout encoder; it compares wall profiles if a job has predicted ones."""

    def __init__(self, layout_encoder: LayoutNetwork, config: LpoConfig | None = None) -> None:
        layout_encoder = layout_encoder.eval().requires_grad_(False)
        self.encoder = layout_encoder.fused() if isinstance(layout_encoder, RingLayoutEncoder) else layout_encoder
        self._device = next(layout_encoder.parameters()).device
        self._config = config or LpoConfig()
        self._columns = self.encoder.config.profile_columns

    @classmethod
    def from_bundle(cls, bundle: Bundle, config: LpoConfig | None = None) -> PoseRefiner:
        """Load the layout encoder of a bundle."""
        manifest = bundle.manifest
        try:
            encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
        except (RuntimeError, ValueError, TypeError) as error:
            raise BundleError(f"bundle '{bundle.folder}': layout encoder does not load: {error}") from error
        return cls(encoder, config)

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Refine every starting pose of a job within its own room, by wall profiles if it has them, else by latents."""
        if job.log_profile is None or job.precision is None:
            optimiser = PoseOptimiser(self.encoder, self._columns, config=self._config, device=self._device)
            return optimiser.refine(replace(job, precision=None))
        result = refine_walls(job, self._config)
        # Without a time limit there is always a result.
        assert result is not None
        if not job.latent_weight:
            return result
        distance = self._latent_distance(job, result)
        return replace(result, cost=result.cost + job.latent_weight * distance, latent_distance=distance)

    @torch.no_grad()
    def _latent_distance(self, job: RefinementJob, result: RefinementResult) -> Float[np.ndarray, "k"]:
        """Return the distances of the refined poses' latents to the query's."""

        def tensor(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=self._device)

        relative = tensor(job.walls_m - np.tile(result.position_m, 2)[:, None, :])
        profile = wall_profile(torch.zeros_like(relative[:, 0, :2]), tensor(result.heading), relative, self._columns)
        latent = self.encoder(profile, tensor(job.camera_height_m), tensor(job.ceiling_height_m))
        return torch.linalg.vector_norm(latent - tensor(job.targets), dim=1).cpu().numpy()
