"""Networks of the architectures `ring` and `paper`: shapes, parameter names and invariants without training."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
import safetensors.torch
import torch

from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.nets import load_layout_encoder
from lalaloc_core.nets.layout_network import RingConfig, RingLayoutEncoder, pad_around
from lalaloc_core.nets.paper_encoders import PaperConfig, PaperImageEncoder, PaperLayoutEncoder, ResNet
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder

TINY = PRESETS["tiny"].ring
SMALL_PAPER = PaperConfig(layout_height=32, profile_columns=64, image_height=64, image_width=128)


def layouts(count: int, columns: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    profile = torch.empty(count, columns).uniform_(0.5, 6.0, generator=torch.Generator().manual_seed(1))
    return profile, torch.linspace(1.2, 1.7, count), torch.linspace(2.3, 3.0, count)


class TestResNet:
    def test_backbones_match_torchvision(self) -> None:
        backbones = ResNet(18), ResNet(50)
        counts = [sum(p.numel() for p in backbone.parameters()) for backbone in backbones]
        assert counts == [11_176_512, 23_508_032]
        assert [backbone.channels for backbone in backbones] == [512, 2048]
        state, deep = (
            {name: tuple(value.shape) for name, value in backbone.state_dict().items()} for backbone in backbones
        )
        expected = {
            "conv1.weight": (64, 3, 7, 7),
            "bn1.running_mean": (64,),
            "bn1.num_batches_tracked": (),
            "layer1.0.conv1.weight": (64, 64, 3, 3),
            "layer1.1.bn2.bias": (64,),
            "layer2.0.downsample.0.weight": (128, 64, 1, 1),
            "layer2.0.downsample.1.running_var": (128,),
            "layer4.1.conv2.weight": (512, 512, 3, 3),
        }
        assert {name: state.get(name) for name in expected} == expected
        assert not any(name.startswith("layer1.0.downsample") for name in state)
        assert len(state) == 120
        expected = {
            "layer1.0.downsample.0.weight": (256, 64, 1, 1),
            "layer1.0.conv3.weight": (256, 64, 1, 1),
            "layer3.5.bn3.weight": (1024,),
            # As in torchvision, the 3x3 convolution has the stride.
            "layer4.2.conv2.weight": (512, 512, 3, 3),
        }
        assert {name: deep.get(name) for name in expected} == expected
        assert len(deep) == 318
        block = backbones[1].get_submodule("layer2.0")
        strides = [block.get_submodule(name).stride for name in ("conv1", "conv2", "conv3")]
        assert strides == [(1, 1), (2, 2), (1, 1)]


class TestPaper:
    def test_latents_are_unit_vectors_of_the_configured_size(self) -> None:
        latent = PaperLayoutEncoder(SMALL_PAPER).eval()(*layouts(3, 64))
        assert latent.shape == (3, 128)
        torch.testing.assert_close(latent.norm(dim=1), torch.ones(3))
        image = torch.randint(0, 256, (2, 64, 128, 3), dtype=torch.uint8)
        latent = PaperImageEncoder(SMALL_PAPER).eval()(image)
        assert latent.shape == (2, 128)
        torch.testing.assert_close(latent.norm(dim=1), torch.ones(2))

    def test_layout_encoder_uses_the_heights(self) -> None:
        torch.manual_seed(0)
        encoder = PaperLayoutEncoder(SMALL_PAPER).eval()
        profile, camera, ceiling = layouts(2, 64)
        assert not torch.allclose(encoder(profile, camera, ceiling), encoder(profile, camera, ceiling + 0.5), atol=1e-4)

    @pytest.mark.parametrize("depth", [18, 50])
    @pytest.mark.parametrize("predictor", ["fc", "mlp"])
    def test_paper_variants_load_from_a_manifest(self, depth: Any, predictor: Any) -> None:
        torch.manual_seed(0)
        config = dataclasses.replace(SMALL_PAPER, layout_depth=depth, layout_predictor=predictor, width=8)
        encoder = PaperLayoutEncoder(config).eval()
        sizes = json.loads(json.dumps(dataclasses.asdict(config)))
        loaded = load_layout_encoder("paper", sizes, safetensors.torch.save(encoder.state_dict())).eval()
        inputs = layouts(3, 64)
        torch.testing.assert_close(loaded(*inputs), encoder(*inputs))

    def test_mlp_predictor_has_one_hidden_layer(self) -> None:
        encoder = PaperLayoutEncoder(dataclasses.replace(SMALL_PAPER, layout_predictor="mlp"))
        shapes = {name: tuple(p.shape) for name, p in encoder.fc.named_parameters() if p.ndim == 2}
        assert list(shapes.values()) == [(512, 512), (128, 512)]

    def test_old_manifests_load(self) -> None:
        old = dataclasses.asdict(SMALL_PAPER)
        del old["layout_predictor"], old["width"]
        state = PaperLayoutEncoder(SMALL_PAPER).state_dict()
        assert "fc.weight" in state
        load_layout_encoder("paper", old, safetensors.torch.save(state))


class TestRing:
    def test_latents_are_unit_vectors_of_the_configured_size(self) -> None:
        encoder = RingLayoutEncoder(TINY).eval()
        latent = encoder(*layouts(5, TINY.profile_columns))
        assert latent.shape == (5, TINY.latent_size)
        torch.testing.assert_close(latent.norm(dim=1), torch.ones(5))
        assert encoder.ring(*layouts(5, TINY.profile_columns)).shape == (5, TINY.channels, TINY.sectors)

    @pytest.mark.parametrize("config", [TINY, RingConfig()], ids=["tiny", "default"])
    def test_image_encoder_output_shapes(self, config: RingConfig) -> None:
        encoder = RingImageEncoder(config).eval()
        image = torch.randint(0, 256, (2, config.image_height, config.image_width, 3), dtype=torch.uint8)
        with torch.no_grad():
            features = encoder(image, torch.tensor([1.3, 1.6]))
        assert features.ring.shape == (2, config.channels, config.sectors)
        walls = features.walls
        assert walls.log_profile.shape == walls.log_scale.shape == (2, config.profile_columns, 1)

    def test_fused_encoder_gives_the_same_output(self) -> None:
        torch.manual_seed(0)
        encoder = RingLayoutEncoder(TINY).train()
        for _ in range(3):
            encoder(*layouts(8, TINY.profile_columns))
        encoder.eval()
        before = {name: value.clone() for name, value in encoder.state_dict().items()}
        fused = encoder.fused()
        inputs = layouts(5, TINY.profile_columns)
        torch.testing.assert_close(fused(*inputs), encoder(*inputs), atol=1e-5, rtol=1e-4)
        assert all(torch.equal(before[name], value) for name, value in encoder.state_dict().items())
        assert not any(isinstance(module, torch.nn.BatchNorm1d) for module in fused.modules())

    def test_extreme_distances_do_not_give_nan(self) -> None:
        encoder = RingLayoutEncoder(TINY).eval()
        profile, camera, ceiling = layouts(2, TINY.profile_columns)
        profile[0, 3], profile[1, 5] = float("inf"), 0.0
        assert bool(torch.isfinite(encoder(profile, camera, ceiling)).all())

    def test_predicted_profile_scales_with_camera_height(self) -> None:
        # The untrained features depend on the height too; without that input only the units remain.
        encoder = RingImageEncoder(TINY).eval()
        with torch.no_grad():
            encoder.squeeze.weight[:, -1] = 0.0
            image = torch.randint(0, 256, (1, TINY.image_height, TINY.image_width, 3), dtype=torch.uint8)
            low, high = (encoder(image, torch.tensor([height])).walls.log_profile for height in (1.0, 2.0))
        torch.testing.assert_close(high - low, torch.full_like(low, 0.6931472))

    @pytest.mark.parametrize("padding", [0, 1, 3])
    def test_encoder_is_equivariant_to_rolling(self, padding: int) -> None:
        padded = pad_around(torch.arange(6.0)[None, None], padding)[0, 0]
        assert padded.tolist() == [float(i % 6) for i in range(-padding, 6 + padding)]

    def test_incompatible_sizes_are_refused(self) -> None:
        with pytest.raises(ValueError, match="profile_columns is 33"):
            RingLayoutEncoder(dataclasses.replace(TINY, profile_columns=33))
        with pytest.raises(ValueError, match="sectors"):
            RingImageEncoder(dataclasses.replace(TINY, sectors=24, profile_columns=48))


class TestLoading:
    @pytest.mark.parametrize("half", [False, True])
    def test_layout_encoder_loads_from_its_weights(self, half: bool) -> None:
        torch.manual_seed(0)
        encoder = RingLayoutEncoder(TINY).eval()
        state = {k: v.half() if half and v.is_floating_point() else v for k, v in encoder.state_dict().items()}
        # Through JSON, as in a manifest: tuples become lists.
        sizes = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(TINY).items()}
        loaded = load_layout_encoder("ring", sizes, safetensors.torch.save(state)).eval()
        inputs = layouts(3, TINY.profile_columns)
        torch.testing.assert_close(loaded(*inputs), encoder(*inputs), atol=5e-3 if half else 1e-6, rtol=0.0)
        assert all(p.dtype == torch.float32 for p in loaded.parameters())

    def test_other_weights_and_unknown_architecture_are_refused(self) -> None:
        state = RingLayoutEncoder(TINY).state_dict()
        for wrong in ({**state, "extra": torch.zeros(1)}, {k: v for k, v in state.items() if k != "head.fc.bias"}):
            with pytest.raises(RuntimeError, match="state_dict"):
                load_layout_encoder("ring", dataclasses.asdict(TINY), safetensors.torch.save(wrong))
        with pytest.raises(ValueError, match="'transformer'"):
            load_layout_encoder("transformer", {}, b"")
