"""Training configuration: frozen, typed, strict about unknown keys; it travels inside every checkpoint."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError
from lalaloc_core.nets.decoder import DECODED_WIDTH
from lalaloc_core.nets.image_encoder import TrunkEncoderConfig
from lalaloc_core.nets.layout_encoder import RingConfig
from lalaloc_core.nets.paper_encoders import PaperConfig
from lalaloc_core.render.sampling import TripletSampling

Architecture = Literal["ring", "trunk", "paper"]
Turns = Literal["any", "quarters", "none"]
_MAX_RAYS = 8
_OF_TRUNK = ("pretrained", "opening_weight", "ceiling_weight", "room_type_weight", "photograph_weight")
# Of the spread; errors are cut off at three times that, and no camera stands lower than a metre or so.
_MAX_HEIGHT_ERROR_M = 0.2


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Optimiser and learning-rate schedule; fractions are of the whole stage.

    Attributes:
        schedule: "cosine" falls to 1 % all the way; "steps" multiplies by `gamma` at each milestone; "trapezoid" stays
            at the full rate and falls to 1 % at the end, as 1 - √, so that a run may be prolonged before it falls.
        warmup: share in which the rate rises, from 5 %.
        decay: share in which a trapezoid falls.
        trunk_factor: the rate of a pretrained trunk in units of everything else's; the lower, the nearer it stays to
            what it knew.
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


@dataclass(frozen=True, kw_only=True)
class LayoutStageConfig:
    """Stage 1: the layout encoder alone, log-ratio and decoding losses (paper, section 3.1).

    Attributes:
        minutes: wall-clock budget; when given, it and not `steps` sets the pace of the schedule.
        all_pairs: compare every two neighbours of an anchor instead of positives with negatives only.
        turned_share: share of the negatives replaced by positives' places seen at another heading.
        log_ratio_weight: weight of the log-ratio loss; 0 leaves it out.
        decode_weight: weight of the decoding loss; 0 leaves it, and the decoder, out.
        decode_anchors_only: decode the anchors' latents alone; the decoder costs more than a small encoder.
        cloud_rows, cloud_columns: sub-sampling of the layouts whose Chamfer distances are taken.
        scale_weight: weight of the loss that fixes the global scale of latent distances, which the log-ratio
            leaves free and which otherwise shrinks.
        latent_per_metre: the latent distance that one metre of Chamfer distance should be worth.
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

    End-to-end training, which is both stages at once, takes its schedule and the weight of its latent distance from
    here as well, and everything else from `LayoutStageConfig`.

    Attributes:
        minutes: wall-clock budget; when given, it and not `steps` sets the pace of the schedule.
        by_room_share: share of the panoramas drawn evenly over rooms instead of over the floor, so that closets and
            corridors are seen often enough.
        supersample: rays per pixel along (rows, columns) of generated panoramas; may be changed when a run resumes.
        uses_per_panorama: how often a panorama is learnt from, each time turned and mirrored anew; 1 never repeats.
        replay_panoramas: how many wait for their next use, over all worker processes; the more, the farther apart
            are the uses of one.
        photometric: strength, 0 to 1, of random changes of exposure, contrast and colours.
        camera_height_error_m: spread (normal) of the error of the camera heights that the networks are told. Targets
            are the true walls at the told height, because that is what a query is compared with: the grid is embedded
            at the told height as well.
        l2_weight: weight of the latent distance, the paper's choice; 0 leaves it out.
        log_ratio_weight: weight of the log-ratio loss with the panorama as anchor and layouts as neighbours, drawn as
            in stage 1.
        kd_weight: weight of the same loss with the layout encoder's distances in place of the Chamfer distances.
        ring_weight: weight of distilling ring features (architectures `ring` and `trunk`).
        profile_weight: weight of the Laplace likelihood of the wall profile (architectures `ring` and `trunk`).
        optics: strength, 0 to 1, of random changes by lens and file: blur, vignetting, seams, tone curves, JPEG.
        pretrained: begin with the trunk's weights of ImageNet (architecture `trunk`).
        opening_weight: weight of the cross entropy of what is met at each azimuth (architecture `trunk`, like the
            following).
        opening_balance: 0 lets every azimuth count alike in it, 1 every class, whatever its share of the azimuths.
        ceiling_weight: weight of the Laplace likelihood of the ceiling's height.
        room_type_weight: weight of the cross entropy of the room's type.
        photograph_weight: weight of following a teacher's maps on photographs without labels, where there are any.
        photograph_profile_weight: weight of following its lines of floor and ceiling on them.
        photographs_per_batch: how many of them are added to each batch.
        style_mixing: where there are photographs, share of a batch's pictures whose early features take on another's
            style, every other time that of a photograph.
        ema_decay: decay per step of the averaged weights that are validated and shipped; 0 turns it off.
    """

    steps: int = 20000
    minutes: float | None = None
    batch: int = 32
    shots_per_home: int = 4
    by_room_share: float = 0.25
    supersample: tuple[int, int] = (1, 1)
    uses_per_panorama: int = 1
    replay_panoramas: int = 4096
    photometric: float = 0.0
    camera_height_error_m: float = 0.0
    l2_weight: float = 1.0
    log_ratio_weight: float = 0.0
    kd_weight: float = 0.0
    ring_weight: float = 0.0
    profile_weight: float = 0.0
    optics: float = 0.0
    pretrained: bool = False
    opening_weight: float = 0.0
    opening_balance: float = 0.5
    ceiling_weight: float = 0.0
    room_type_weight: float = 0.0
    photograph_weight: float = 0.0
    photograph_profile_weight: float = 0.0
    photographs_per_batch: int = 4
    style_mixing: float = 0.0
    ema_decay: float = 0.0
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides what is trained, but the data.

    Attributes:
        turns: the headings that layouts and panoramas are turned to: any, and mirrored or not; a multiple of a quarter
            turn, and mirrored or not; or none but heading 0, which is enough for queries whose heading is known.
    """

    name: str
    architecture: Architecture = "ring"
    seed: int = 0
    turns: Turns = "any"
    ring: RingConfig = field(default_factory=RingConfig)
    trunk: TrunkEncoderConfig = field(default_factory=TrunkEncoderConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)
    layout: LayoutStageConfig = field(default_factory=LayoutStageConfig)
    image: ImageStageConfig = field(default_factory=ImageStageConfig)

    def __post_init__(self) -> None:
        """Refuse what cannot be trained.

        Raises:
            ConfigError: names the key, its value and the limit.
        """
        for name, wanted in (("layout.cloud_columns", self.layout.cloud_columns), ("the decoder", DECODED_WIDTH)):
            if self.profile_columns % min(wanted, self.profile_columns):
                raise ConfigError(f"{self.profile_columns} profile columns cannot be thinned to {wanted} ({name})")
        if not self.layout.log_ratio_weight and not self.layout.decode_weight:
            raise ConfigError("config.layout: log_ratio_weight and decode_weight are both 0, nothing is learnt")
        image = self.image
        if not any((image.l2_weight, image.log_ratio_weight, image.kd_weight, image.ring_weight)):
            raise ConfigError("config.image: the weights of all losses on the latent are 0, nothing is learnt")
        if len(image.supersample) != 2 or not all(1 <= rays <= _MAX_RAYS for rays in image.supersample):
            raise ConfigError(f"config.image.supersample is {image.supersample}, it must be two of 1 to {_MAX_RAYS}")
        for name in ("uses_per_panorama", "replay_panoramas"):
            if getattr(image, name) < 1:
                raise ConfigError(f"config.image.{name} is {getattr(image, name)}, it must be at least 1")
        for name in ("photometric", "optics", "opening_balance"):
            if not 0.0 <= getattr(image, name) <= 1.0:
                raise ConfigError(f"config.image.{name} is {getattr(image, name):g}, it must lie within 0 and 1")
        if self.architecture != "trunk":
            for name in _OF_TRUNK:
                if getattr(image, name):
                    raise ConfigError(
                        f"config.image.{name} is {getattr(image, name)}, but only architecture 'trunk' has what it is "
                        f"for, and this is '{self.architecture}'"
                    )
        if image.photographs_per_batch < 1:
            raise ConfigError(
                f"config.image.photographs_per_batch is {image.photographs_per_batch}, at least 1 is needed"
            )
        if not 0.0 <= image.camera_height_error_m <= _MAX_HEIGHT_ERROR_M:
            raise ConfigError(
                f"config.image.camera_height_error_m is {image.camera_height_error_m:g}, "
                f"it must lie within 0 and {_MAX_HEIGHT_ERROR_M:g} m"
            )
        for part in ("layout", "image"):
            optimiser = getattr(self, part).optimiser
            if not 0.0 < optimiser.decay <= 1.0 - optimiser.warmup:
                raise ConfigError(
                    f"config.{part}.optimiser.decay is {optimiser.decay:g}, it must lie within 0 "
                    f"and what the warm-up leaves, {1.0 - optimiser.warmup:g}"
                )
        if self.layout.turned_share and self.turns != "any":
            raise ConfigError(
                f"config.layout.turned_share is {self.layout.turned_share:g}, with turns other than 'any'"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for checkpoints and manifests."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, raw: dict[str, Any]) -> TrainConfig:
        """Rebuild strictly.

        Raises:
            ConfigError: an unknown key or a value of the wrong type, named with its path.
        """
        return build_config(cls, raw, path="config")

    def with_settings(self, settings: dict[str, Any]) -> TrainConfig:
        """Replace single settings, each by its path such as "image.optimiser.learning_rate".

        Raises:
            ConfigError: no such setting, or a value of the wrong type.
        """
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
        """The same with other sizes of the networks that they are sizes of."""
        names = {RingConfig: "ring", TrunkEncoderConfig: "trunk", PaperConfig: "paper"}
        return dataclasses.replace(self, **{names[type(part)]: part for part in sizes})

    @property
    def has_ring(self) -> bool:
        """Whether both branches meet in features around the horizon."""
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
    def latent_size(self) -> int:
        """Dimensions of the latent."""
        return self.layout_sizes.latent_size

    @property
    def profile_columns(self) -> int:
        """Azimuth columns that the layout encoder expects."""
        return self.layout_sizes.profile_columns

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) that the image encoder expects."""
        return self.image_sizes.image_height, self.image_sizes.image_width
