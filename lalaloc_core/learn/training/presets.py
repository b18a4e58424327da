"""Presets of `lalaloc lab train --preset`, including tiny ones for tests."""

from __future__ import annotations

import dataclasses

from lalaloc_core.learn.training.config import ImageStageConfig, LayoutStageConfig, OptimiserConfig, TrainConfig
from lalaloc_core.nets.layout_network import RingConfig
from lalaloc_core.nets.object_network import OBJECTS
from lalaloc_core.nets.sphere_network import TrunkEncoderConfig
from lalaloc_core.nets.trunk import TrunkConfig
from lalaloc_core.nets.view_network import ViewEncoderConfig
from lalaloc_core.render.sampling import TripletSampling

PAPER_SGD = OptimiserConfig(kind="sgd", learning_rate=0.01, schedule="steps", warmup=0.0, clip_norm=0.0)

_RING_LAYOUT = LayoutStageConfig(
    triplets=TripletSampling(positives=4, negatives=8),
    all_pairs=True,
    turned_share=0.25,
    decode_weight=0.3,
    decode_anchors_only=True,
    cloud_rows=8,
    cloud_columns=32,
    scale_weight=0.1,
    optimiser=OptimiserConfig(learning_rate=2e-3),
)

# For tests.
_TINY_TRUNK = TrunkConfig(stem=8, widths=(8, 8, 8, 8, 8, 8, 8), repeats=(1, 1, 1, 1, 1, 1, 1), frozen_stages=1)
_TINY = TrainConfig(
    name="tiny",
    ring=RingConfig(
        sectors=16,
        channels=8,
        profile_columns=32,
        layout_width=16,
        layout_dilations=(1,),
        image_height=32,
        image_width=64,
        image_stem=8,
        image_widths=(8, 12),
        image_blocks=(1, 1),
        mixer_width=16,
        mixer_blocks=1,
        mixer_heads=2,
    ),
    trunk=TrunkEncoderConfig(
        image_height=32,
        image_width=64,
        trunk=_TINY_TRUNK,
        squeezed=(8, 8, 8, 8),
        mixer_width=16,
        mixer_blocks=1,
        mixer_heads=2,
        modes=2,
    ),
    view=ViewEncoderConfig(
        image_height=64,
        image_width=64,
        sectors=4,
        trunk=_TINY_TRUNK,
        squeezed=(8, 8, 8, 8),
        mixer_width=16,
        mixer_blocks=1,
        mixer_heads=2,
    ),
    layout=LayoutStageConfig(
        steps=40,
        homes_per_step=2,
        anchors_per_home=2,
        triplets=TripletSampling(positives=2, negatives=4),
        all_pairs=True,
        decode_anchors_only=True,
        scale_weight=0.1,
    ),
    image=ImageStageConfig(steps=12, batch=8, ring_weight=1.0, profile_weight=0.5, ema_decay=0.9),
)

# The paper counts epochs over Structured3D, whose training split has about 18,000 spheres.
PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(
        name="paper",
        architecture="paper",
        layout=LayoutStageConfig(steps=90_000, homes_per_step=4, anchors_per_home=1, optimiser=PAPER_SGD),
        image=ImageStageConfig(
            steps=56_000, batch=64, shots_per_home=1, optimiser=dataclasses.replace(PAPER_SGD, learning_rate=0.1)
        ),
    ),
    "ring": TrainConfig(
        name="ring",
        layout=_RING_LAYOUT,
        image=ImageStageConfig(
            photometric=1.0,
            camera_height_error_m=0.02,
            ring_weight=1.0,
            profile_weight=0.5,
            ema_decay=0.999,
            optimiser=OptimiserConfig(learning_rate=1.5e-3),
        ),
    ),
    # Same layout branch as `ring`.
    "trunk": TrainConfig(
        name="trunk",
        architecture="trunk",
        trunk=TrunkEncoderConfig(modes=2),
        view=ViewEncoderConfig(objects=len(OBJECTS)),
        layout=_RING_LAYOUT,
        image=ImageStageConfig(
            photometric=1.0,
            optics=1.0,
            supersample=(2, 2),
            uses_per_sphere=4,
            replay_spheres=1024,
            pretrained=True,
            ring_weight=0.5,
            profile_weight=1.0,
            opening_weight=1.0,
            edges_weight=0.3,
            ceiling_weight=0.2,
            room_type_weight=0.1,
            photograph_weight=0.3,
            photograph_profile_weight=0.3,
            photographs_per_batch=8,
            style_mixing=0.5,
            ema_decay=0.998,
            optimiser=OptimiserConfig(learning_rate=1.5e-3, schedule="trapezoid", warmup=0.03, trunk_factor=0.05),
        ),
    ),
    "tiny": _TINY,
    "tiny-trunk": dataclasses.replace(
        _TINY,
        name="tiny-trunk",
        architecture="trunk",
        image=dataclasses.replace(
            _TINY.image,
            optics=1.0,
            opening_weight=1.0,
            edges_weight=0.3,
            ceiling_weight=0.2,
            room_type_weight=0.1,
            photograph_weight=0.3,
            photograph_profile_weight=0.3,
            photographs_per_batch=2,
            style_mixing=0.5,
            optimiser=OptimiserConfig(trunk_factor=0.3),
        ),
    ),
}
