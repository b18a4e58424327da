"""VDR + Decode: the pose is aligned with the layout that the training decoder makes of the query's latent.

The paper compares optimisation in the latent space with optimisation of an explicit layout in this way (section 6.1.2).
Retrieval and VDR are LaLaLoc's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch.nn import functional

from lalaloc_core.evaluate.methods.explicit import depth_aligner
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, encode, found_pose, grid_index, read_image
from lalaloc_core.evaluate.methods.method import Answer, Question
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.refine.refinement import refinement_job
from lalaloc_core.localise.search.pipeline import LocaliseConfig, StageClock, localise
from lalaloc_core.nets.decoder import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder


class VdrDecode:
    """Method with a bundle and the decoder that its layout encoder was trained with."""

    def __init__(self, encoders: PhotographEncoder, decoder: LayoutDecoder) -> None:
        self._lalaloc = LaLaLoc(encoders, refine="vdr")
        # The paper compares latents only.
        self._config = LocaliseConfig(matching=MatchingConfig(use_profile=False))
        self._decoder = decoder.eval().requires_grad_(False)
        # Training shows the decoder every n-th column of the encoder's wall profile.
        columns = encoders.manifest.profile_columns
        thinning = max(columns // DECODED_WIDTH, 1)
        self._width = len(range(0, columns, thinning))
        self._aligner = depth_aligner(rows=DECODED_HEIGHT, columns=columns, thinning=thinning)

    def locate(self, question: Question) -> Answer:
        """Retrieve, re-sample with VDR, decode the query's latent and align."""
        encoders, plan, clock = self._lalaloc.encoders, question.plan, StageClock()
        image = read_image(encoders, question)
        with clock.stage("encode"):
            query = encode(encoders, question, image)
        grid = self._lalaloc.grid(question)
        found = localise(plan, grid, encoders.layouts, query, refine="vdr", config=self._config)
        clock.timings_ms.update(found.timings_ms)
        with clock.stage("decode"):
            start = found.candidates[0]
            job = refinement_job(
                plan,
                query,
                [start],
                grid.camera_height_m,
                encoders.manifest.evidence_for(view=query.is_view),
                self._config.matching,
            )
            result = self._aligner.refine(replace(job, targets=self.decode(job.targets)))
        aligned = replace(
            start,
            x_m=float(result.position_m[0, 0]),
            y_m=float(result.position_m[0, 1]),
            frame_heading=float(result.heading[0]),
            cost=float(result.cost[0]),
        )
        best = {**found.best, "decode": aligned}
        return Answer(
            stages={stage: found_pose(query, candidate) for stage, candidate in best.items()},
            retrieved=grid_index(grid, best["retrieval"]),
            timings_ms=clock.timings_ms,
        )

    def decode(self, latents: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k pixels"]:
        """Return flattened layout depths (m) of latents, as wide as the layouts to compare."""
        with torch.no_grad():
            depth = self._decoder(torch.from_numpy(np.asarray(latents, dtype=np.float32)))
            # Training compares at the width of the profile where that is narrower than the decoder's images.
            narrowed = functional.interpolate(depth[:, None], (DECODED_HEIGHT, self._width))
        return narrowed.flatten(1).numpy()
