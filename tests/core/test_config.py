"""Training configuration: round trips and refusal of invalid values."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.training.config import PRESETS, OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.loop import learning_rate


@pytest.mark.parametrize("name", PRESETS)
def test_configuration_round_trip(name: str) -> None:
    config = PRESETS[name]
    assert TrainConfig.from_dict(config.to_dict()) == config
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert config.name == name


def test_integers_are_accepted_as_floats() -> None:
    raw = PRESETS["tiny"].to_dict()
    raw["image"]["minutes"] = 3
    raw["layout"]["optimiser"]["learning_rate"] = 1
    config = TrainConfig.from_dict(raw)
    assert isinstance(config.image.minutes, float)
    assert isinstance(config.layout.optimiser.learning_rate, float)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["lerning_rate"], 1.0, "config has no key 'lerning_rate'"),
        (["layout", "optimiser", "lr"], 1.0, r"config\.layout\.optimiser has no key 'lr'"),
        (["architecture"], "transformer", r"config\.architecture is 'transformer'"),
        (["seed"], 1.5, r"config\.seed is 1\.5"),
        (["seed"], True, r"config\.seed is True"),
        (["layout", "all_pairs"], 1, r"config\.layout\.all_pairs is 1"),
        (["layout", "decode_weight"], "0.3", r"config\.layout\.decode_weight is '0\.3'"),
        (["layout", "decode_weight"], False, r"config\.layout\.decode_weight is False"),
        (["layout"], [], r"config\.layout must be a mapping"),
        (["ring", "image_widths"], 3, r"config\.ring\.image_widths is 3"),
        (["ring", "image_widths"], [8, "x"], r"config\.ring\.image_widths\[1\] is 'x'"),
        (["image", "supersample"], [1, 2, 1, 2], r"config\.image\.supersample is \[1, 2, 1, 2\]"),
        (["image", "l2_weight"], float("nan"), r"config\.image\.l2_weight is nan: Input should be a finite number"),
        (["image", "supersample"], [1], r"config\.image\.supersample is \[1\]: it has too few items"),
        (["layout", "triplets", "positives"], 1.5, r"config\.layout\.triplets\.positives"),
        (
            ["layout", "cloud_columns"],
            24,
            r"profile_columns is 32; it must be a multiple of 24 \(layout\.cloud_columns\)",
        ),
        (["ring", "profile_columns"], 80, r"profile_columns is 80; it must be a multiple of \d+"),
        (["layout"], {"log_ratio_weight": 0.0, "decode_weight": 0.0}, "are both 0; set one above 0"),
        (["image"], {"l2_weight": 0.0, "profile_weight": 1.0}, "are all 0; set one above 0"),
        (["paper", "layout_depth"], 34, r"config\.paper\.layout_depth is 34"),
    ],
)
def test_invalid_configuration_is_refused(path: list[str], value: Any, message: str) -> None:
    raw = PRESETS["tiny"].to_dict()
    inner = raw
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises(ConfigError, match=message):
        TrainConfig.from_dict(raw)


@dataclasses.dataclass(frozen=True)
class Sized:
    """Size as one number, as (rows, columns), or by name."""

    size: int | tuple[int, int] | str | None


@pytest.mark.parametrize("size", [3, (2, 4), "small", None])
def test_union_members_are_accepted(size: Any) -> None:
    assert build_config(Sized, {"size": size}) == Sized(size)


@pytest.mark.parametrize("size", [1.5, (2, 4, 6), (2,), True, {"rows": 2}])
def test_values_outside_a_union_are_refused(size: Any) -> None:
    with pytest.raises(ConfigError, match=r"config\.size"):
        build_config(Sized, {"size": size})


def test_paper_preset_matches_the_paper() -> None:
    config = PRESETS["paper"]
    assert (config.paper.layout_depth, config.paper.image_depth, config.paper.latent_size) == (18, 50, 128)
    assert (config.layout.triplets.positives, config.layout.triplets.negatives) == (1, 20)
    assert (config.layout.triplets.positive_radius_m, config.layout.triplets.negative_radius_m) == (0.5, 2.0)
    assert not config.layout.all_pairs
    assert config.layout.optimiser.kind == config.image.optimiser.kind == "sgd"


def test_sizes_follow_the_architecture() -> None:
    config = PRESETS["tiny"]
    paper = dataclasses.replace(config, architecture="paper")
    assert (config.profile_columns, config.image_size) == (32, (32, 64))
    assert (paper.profile_columns, paper.image_size) == (256, (256, 512))


def test_turned_negatives_need_turned_layouts() -> None:
    config = PRESETS["ring"]
    assert config.layout.turned_share > 0.0
    with pytest.raises(ConfigError, match=r"turned_share is 0\.25"):
        dataclasses.replace(config, turns="none")


def test_old_configuration_loads_unless_it_lacks_keys_without_default() -> None:
    raw = PRESETS["paper"].to_dict()
    del raw["turns"], raw["layout"]["log_ratio_weight"], raw["image"]["log_ratio_weight"], raw["image"]["kd_weight"]
    del raw["paper"]["layout_predictor"], raw["paper"]["width"]
    assert TrainConfig.from_dict(raw) == PRESETS["paper"]
    with pytest.raises(ConfigError, match="name"):
        TrainConfig.from_dict({"seed": 1})


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("image.uses_per_sphere", 0, "uses_per_sphere is 0"),
        ("image.photometric", 1.5, "photometric is 1.5"),
        ("image.camera_height_error_m", -0.1, "camera_height_error_m is -0.1"),
        ("image.opening_balance", -0.1, "opening_balance is -0.1"),
        ("image.supersample", [0, 2], "supersample"),
        ("image.optimiser.decay", 1.0, "decay is 1"),
        ("image.uses", 2, "no key 'uses'"),
        ("pictures.uses", 2, "no part 'pictures'"),
    ],
)
def test_invalid_settings_are_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        PRESETS["tiny"].with_settings({setting: value})


def test_single_settings_are_replaced() -> None:
    config = PRESETS["tiny"].with_settings({"image.supersample": [2, 1], "image.optimiser.learning_rate": 1})
    assert config.image.supersample == (2, 1)
    assert config.image.optimiser.learning_rate == 1.0
    assert TrainConfig.from_dict(config.to_dict()) == config


class TestLearningRate:
    def test_cosine_schedule(self) -> None:
        config = OptimiserConfig(learning_rate=1.0, warmup=0.1)
        rates = [learning_rate(config, step / 200) for step in range(201)]
        assert rates[0] == pytest.approx(0.05)
        assert rates[:20] == sorted(rates[:20])
        assert rates[20:] == sorted(rates[20:], reverse=True)
        assert max(rates) == pytest.approx(1.0, abs=0.03)
        assert rates[100] == pytest.approx(0.505)
        assert rates[-1] == pytest.approx(0.01)

    def test_trapezoid_schedule(self) -> None:
        config = OptimiserConfig(learning_rate=2.0, schedule="trapezoid", warmup=0.1, decay=0.2)
        rates = [learning_rate(config, progress) for progress in (0.0, 0.05, 0.1, 0.5, 0.8, 0.85, 1.0)]
        assert rates == pytest.approx([0.1, 1.05, 2.0, 2.0, 2.0, 2.0 * (0.01 + 0.99 * 0.5), 0.02])

    def test_step_schedule(self) -> None:
        config = OptimiserConfig(learning_rate=0.1, schedule="steps", warmup=0.0, milestones=(0.5, 0.75), gamma=0.1)
        rates = [learning_rate(config, progress) for progress in (0.0, 0.49, 0.5, 0.74, 0.75, 1.0)]
        assert rates == pytest.approx([0.1, 0.1, 0.01, 0.01, 0.001, 0.001])
