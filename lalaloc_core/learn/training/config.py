"""Training configuration: frozen, typed, strict about unknown keys; stored in every checkpoint. With its presets."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError
from lalaloc_core.nets import DECODED_WIDTH, PaperConfig, RingConfig, TrunkEncoderConfig, ViewEncoderConfig
from lalaloc_core.render.sampling import TripletSampling

Architecture = Literal["ring", "trunk", "paper"]
Turns = Literal["any", "quarters", "none"]
_MAX_RAYS = 8
_TRUNK_ONLY = (
    "pretrained",
    "opening_weight",
    "edges_weight",
    "ceiling_weight",
    "room_type_weight",
    "photograph_weight",
)
# Limit of the spread; errors are clipped at three times the spread, and cameras stand about 1 m high or more.
_MAX_HEIGHT_ERROR_M = 0.2


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Optimiser and learning-rate schedule; shares are of the whole stage.

    Attributes:
        kind: AdamW, or SGD with momentum.
        weight_decay: L2 penalty; AdamW applies it to matrices only.
        schedule: "cosine" decays to 1 % over the whole stage; "steps" multiplies by `gamma` at each milestone;
            "trapezoid" keeps the full rate and decays to 1 % as 1 - √ at the end, so a run can be extended before.
        warmup: share in which the rate rises from 5 %.
        decay: share in which a trapezoid decays.
        milestones: shares at which "steps" lowers the rate.
        clip_norm: maximum norm of the gradient; 0 turns clipping off.
        trunk_factor: factor on the learning rate of a pretrained trunk; lower values keep it closer to its weights.
        only: names, or their beginnings, of the parameters that are trained, such as "image_encoder.to_profile"; the
            others keep their weights. Empty trains all.
        keep_depthwise: keep the depthwise convolutions of a trunk as they are; their gradients take half of a step on a
            processor, and they have a twentieth of the weights.
    """

    kind: Literal["adamw", "sgd"] = "adamw"
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    momentum: float = 0.9
    schedule: Literal["cosine", "steps", "trapezoid"] = "cosine"
    warmup: float = 0.02
    decay: float = 0.2
    milestones: tuple[float, ...] = (0.5, 0.75)
    gamma: float = 0.1
    clip_norm: float = 1.0
    trunk_factor: float = 1.0
    only: tuple[str, ...] = ()
    keep_depthwise: bool = False


@dataclass(frozen=True, kw_only=True)
class LayoutStageConfig:
    """Stage 1: the layout encoder alone, log-ratio and decoding losses (paper, section 3.1).

    Attributes:
        minutes: wall-clock budget; replaces `steps` as the length of the schedule.
        homes_per_step, anchors_per_home: size of a batch.
        all_pairs: compare all pairs of an anchor's neighbours instead of positives with negatives only.
        turned_share: share of the negatives replaced by positions of positives at another heading.
        log_ratio_weight: weight of the log-ratio loss; 0 turns it off.
        decode_weight: weight of the decoding loss; 0 turns it off and removes the decoder.
        decode_anchors_only: decode the anchors' latents only, because the decoder costs more than a small encoder.
        scale_weight: weight of the loss that fixes the global scale of latent distances, which the log-ratio loss
            leaves free and which otherwise shrinks.
        latent_per_metre: target latent distance per metre of Chamfer distance.
        cloud_rows, cloud_columns: resolution of the layouts compared by Chamfer distance.
    """

    steps: int = 6000
    minutes: float | None = None
    homes_per_step: int = 4
    anchors_per_home: int = 4
    triplets: TripletSampling = field(default_factory=TripletSampling)
    all_pairs: bool = False
    turned_share: float = 0.0
    log_ratio_weight: float = 1.0
    decode_weight: float = 1.0
    decode_anchors_only: bool = False
    scale_weight: float = 0.0
    latent_per_metre: float = 0.5
    cloud_rows: int = 16
    cloud_columns: int = 32
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)


@dataclass(frozen=True, kw_only=True)
class ImageStageConfig:
    """Stage 2: the image encoder against the frozen layout encoder (paper, sections 3.2 and A.1.5).

    End-to-end training takes its schedule, batch and latent distance weight from here, and the rest from
    `LayoutStageConfig`.

    Attributes:
        minutes: wall-clock budget; replaces `steps` as the length of the schedule.
        shots_per_home: spheres drawn from one home.
        by_room_share: share of the spheres drawn uniformly over rooms instead of over the floor area, so that small
            rooms occur often enough.
        supersample: rays per pixel along (rows, columns) of generated spheres; may change when a run resumes.
        uses_per_sphere: number of times a sphere is used, each time with a new rotation and mirroring.
        replay_spheres: spheres waiting for their next use, over all workers; more of them separate repeated uses.
        photometric: strength, 0 to 1, of random changes of exposure, contrast and colours.
        camera_height_error_m: standard deviation of the error of the camera heights given to the networks. Targets are
            the true walls at the given height, because the pose grid of a query is embedded at that height too.
        l2_weight: weight of the latent distance, the paper's choice; 0 turns it off.
        log_ratio_weight: weight of the log-ratio loss with the sphere as anchor and layouts as neighbours, drawn as
            in stage 1.
        kd_weight: weight of the same loss with the layout encoder's distances in place of the Chamfer distances.
        ring_weight: weight of ring feature distillation (architectures `ring` and `trunk`).
        profile_weight: weight of the Laplace likelihood of the wall profile (architectures `ring` and `trunk`).
        optics: strength, 0 to 1, of random lens and file effects: blur, vignetting, seams, tone curves, JPEG.
        pretrained: start with ImageNet weights of the trunk (architecture `trunk`).
        shape_weight: weight of the error of a view's walls that remains when its scale is removed (stage `view`).
        opening_weight: weight of the cross entropy of the opening class at each azimuth (architecture `trunk`, like
            all following settings but the last two).
        opening_balance: 0 gives all azimuths the same weight in it, 1 all classes regardless of their share.
        edges_weight: weight of the Laplace likelihood of the elevations of openings' edges, and of the cross entropy of
            seeing the wall at each azimuth.
        ceiling_weight: weight of the Laplace likelihood of the ceiling height.
        room_type_weight: weight of the cross entropy of the room type.
        photograph_weight: weight of a teacher's openings on unlabelled photographs.
        photograph_profile_weight: weight of the teacher's walls on them.
        photographs_per_batch: photographs added to each batch.
        photograph_shares: share of them from each folder; empty draws all photographs alike.
        style_mixing: share of a batch whose early features take on another picture's style, every other time that of a
            photograph; needs photographs.
        ema_decay: decay per step of the averaged weights, which are validated and shipped; 0 turns averaging off.
    """

    steps: int = 20000
    minutes: float | None = None
    batch: int = 32
    shots_per_home: int = 4
    by_room_share: float = 0.25
    supersample: tuple[int, int] = (1, 1)
    uses_per_sphere: int = 1
    replay_spheres: int = 4096
    photometric: float = 0.0
    camera_height_error_m: float = 0.0
    l2_weight: float = 1.0
    log_ratio_weight: float = 0.0
    kd_weight: float = 0.0
    ring_weight: float = 0.0
    profile_weight: float = 0.0
    shape_weight: float = 0.0
    optics: float = 0.0
    pretrained: bool = False
    opening_weight: float = 0.0
    opening_balance: float = 0.5
    edges_weight: float = 0.0
    ceiling_weight: float = 0.0
    room_type_weight: float = 0.0
    photograph_weight: float = 0.0
    photograph_profile_weight: float = 0.0
    photographs_per_batch: int = 4
    photograph_shares: tuple[float, ...] = ()
    style_mixing: float = 0.0
    ema_decay: float = 0.0
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """All settings of a training run except its data.

    Attributes:
        architecture: `ring`, `trunk`, or the networks of the `paper`.
        turns: headings of training layouts and spheres: "any" and "quarters" (multiples of 90°) with random
            mirroring, or "none", heading 0 only, which suffices for queries with known heading.
        ring, trunk, paper: sizes of the networks; an architecture ignores the sizes of others.
        view: sizes of the encoder of views, which architecture `trunk` can have besides.
    """

    name: str
    architecture: Architecture = "ring"
    seed: int = 0
    turns: Turns = "any"
    ring: RingConfig = field(default_factory=RingConfig)
    trunk: TrunkEncoderConfig = field(default_factory=TrunkEncoderConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)
    view: ViewEncoderConfig = field(default_factory=ViewEncoderConfig)
    layout: LayoutStageConfig = field(default_factory=LayoutStageConfig)
    image: ImageStageConfig = field(default_factory=ImageStageConfig)

    def __post_init__(self) -> None:
        for name, wanted in (("layout.cloud_columns", self.layout.cloud_columns), ("the decoder", DECODED_WIDTH)):
            if self.profile_columns % min(wanted, self.profile_columns):
                raise ConfigError(
                    f"profile_columns is {self.profile_columns}; it must be a multiple of {wanted} ({name})"
                )
        if not self.layout.log_ratio_weight and not self.layout.decode_weight:
            raise ConfigError("config.layout: log_ratio_weight and decode_weight are both 0; set one above 0")
        image, rays, turned = self.image, self.image.supersample, self.layout.turned_share
        if not any((image.l2_weight, image.log_ratio_weight, image.kd_weight, image.ring_weight)):
            raise ConfigError(
                "config.image: l2_weight, log_ratio_weight, kd_weight and ring_weight are all 0; set one above 0"
            )
        are_rays = len(rays) == 2 and all(1 <= count <= _MAX_RAYS for count in rays)
        self._check("image.supersample", are_rays, f"it must be two numbers from 1 to {_MAX_RAYS}")
        for name in ("uses_per_sphere", "replay_spheres", "photographs_per_batch"):
            self._check(f"image.{name}", getattr(image, name) >= 1, "the minimum is 1")
        for name in ("photometric", "optics", "opening_balance"):
            self._check(f"image.{name}", 0.0 <= getattr(image, name) <= 1.0, "it must lie between 0 and 1")
        for name in _TRUNK_ONLY:
            limit = f"only architecture 'trunk' supports it, not '{self.architecture}'"
            self._check(f"image.{name}", self.architecture == "trunk" or not getattr(image, name), limit)
        is_small = 0.0 <= image.camera_height_error_m <= _MAX_HEIGHT_ERROR_M
        limit = f"it must lie between 0 and {_MAX_HEIGHT_ERROR_M:g} m"
        self._check("image.camera_height_error_m", is_small, limit)
        for part, optimiser in (("layout", self.layout.optimiser), ("image", image.optimiser)):
            rest = 1.0 - optimiser.warmup
            limit = f"it must be above 0 and at most 1 - warmup, {rest:g}"
            self._check(f"{part}.optimiser.decay", 0.0 < optimiser.decay <= rest, limit)
        self._check("layout.turned_share", not turned or self.turns == "any", "it must be 0 unless turns is 'any'")

    def _check(self, path: str, is_valid: bool, limit: str) -> None:
        if not is_valid:
            value = attrgetter(path)(self)
            raise ConfigError(f"config.{path} is {f'{value:g}' if isinstance(value, float) else value}; {limit}")

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for checkpoints and manifests."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, raw: dict[str, Any]) -> TrainConfig:
        """Build a configuration from plain data, refusing unknown keys."""
        if isinstance(image := raw.get("image"), dict):
            known = (item for item in image.items() if item[0] not in _EARLIER_SETTINGS)
            raw = raw | {"image": {_EARLIER_NAMES.get(name, name): value for name, value in known}}
        return build_config(cls, raw, path="config")

    def with_settings(self, settings: dict[str, Any]) -> TrainConfig:
        """Return a copy with some settings replaced, each by its path such as "image.optimiser.learning_rate"."""
        raw = self.to_dict()
        for path, value in settings.items():
            part, keys = raw, path.split(".")
            for key in keys[:-1]:
                part = part.get(key)
                if not isinstance(part, dict):
                    raise ConfigError(f"config has no part '{path.rpartition('.')[0]}'")
            part[keys[-1]] = value
        return self.from_dict(raw)

    def with_networks(self, *sizes: RingConfig | TrunkEncoderConfig | PaperConfig) -> TrainConfig:
        """Return a copy with other network sizes, each assigned by its type."""
        names = {RingConfig: "ring", TrunkEncoderConfig: "trunk", PaperConfig: "paper"}
        return dataclasses.replace(self, **{names[type(part)]: part for part in sizes})

    @property
    def has_ring(self) -> bool:
        """True if both branches share features around the horizon."""
        return self.architecture != "paper"

    @property
    def layout_sizes(self) -> RingConfig | PaperConfig:
        """Sizes of the layout branch."""
        return self.ring if self.has_ring else self.paper

    @property
    def image_sizes(self) -> RingConfig | TrunkEncoderConfig | PaperConfig:
        """Sizes of the image encoder."""
        return self.trunk if self.architecture == "trunk" else self.layout_sizes

    @property
    def profile_columns(self) -> int:
        """Azimuth columns that the layout encoder expects."""
        return self.layout_sizes.profile_columns

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) that the image encoder expects."""
        return self.image_sizes.image_height, self.image_sizes.image_width


_EARLIER_NAMES = {"uses_per_panorama": "uses_per_sphere", "replay_panoramas": "replay_spheres"}
_EARLIER_SETTINGS = {"hidden_share"}


def _presets() -> dict[str, TrainConfig]:
    presets: dict[str, TrainConfig] = {}
    for name, values in tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8")).items():
        base = presets[values.pop("base")].to_dict() if "base" in values else {}
        presets[name] = TrainConfig.from_dict(_changed(base, values) | {"name": name})
    return presets


def _changed(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with others in their place."""
    return {**base} | {
        key: _changed(base.get(key, {}), value) if isinstance(value, dict) else value for key, value in values.items()
    }


# Presets of `lalaloc lab train --preset`.
PRESETS = _presets()
