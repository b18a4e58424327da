"""Tests of model bundles: export, integrity, identity and confidence."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx
import pytest
import safetensors.torch
import torch

from lalaloc_core.bundle import (
    BUNDLE_FILES,
    DECODER_WEIGHTS,
    DETECTOR_ONNX,
    HEAD_ONNX,
    IMAGE_ONNX,
    IMAGE_WEIGHTS,
    LAYOUT_ONNX,
    LAYOUT_WEIGHTS,
    MANIFEST_NAME,
    OBJECTS_ONNX,
    VIEW_ONNX,
    VIEW_WEIGHTS,
    Bundle,
    ConfidenceModel,
    LogisticModel,
    Manifest,
    write_manifest,
)
from lalaloc_core.errors import BundleError, ExportError
from lalaloc_core.learn.export import bundle_export as export
from lalaloc_core.learn.export.bundle_export import PARITY_TOLERANCE, export_bundle
from lalaloc_core.learn.export.run_export import reexport_bundle
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import PRESETS, TrainConfig
from lalaloc_core.learn.training.stages import build_image_encoder, build_layout_encoder
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.nets import load_decoder
from lalaloc_core.nets.layout_network import LayoutDecoder
from tests.core.test_training import small_paper
from tests.strategies import crooked_flat, present, scene_of

LOGISTIC = LogisticModel(bias=1.0, log_odds=2.0, cost=-4.0, uncertainty=-0.5, latent_distance=-6.0)

TINY = PRESETS["tiny"]


def exported_bundle(folder: Path, config: TrainConfig) -> Bundle:
    return export_bundle(
        folder, config, build_layout_encoder(config), build_image_encoder(config), name="small", version="7"
    )


def assert_layouts_agree(encoders: PhotographEncoder, optimiser: PoseRefiner, count: int, columns: int) -> None:
    """Check that both layout encoders give random profiles the same latents."""
    layouts = (torch.empty(count, columns).uniform_(0.3, 8.0), torch.full((count,), 1.4), torch.full((count,), 2.6))
    latents = encoders.layouts.latents(*(values.numpy() for values in layouts))
    np.testing.assert_allclose(latents, optimiser.encoder(*layouts).numpy(), atol=1e-4)


@pytest.fixture
def bundle_copy(tiny_bundle: Path, tmp_path: Path) -> Path:
    """Copy of the tiny bundle that a test may damage."""
    return Path(shutil.copytree(tiny_bundle, tmp_path / "copy"))


class TestExport:
    def test_manifest_describes_the_exported_files(self, opened_bundle: Bundle) -> None:
        manifest = opened_bundle.manifest
        assert (manifest.name, manifest.version, manifest.architecture) == ("tiny", "test", "ring")
        assert (manifest.image_height, manifest.image_width, manifest.profile_columns) == (32, 64, 32)
        assert (manifest.latent_size, manifest.ring_sectors) == (128, 16)
        assert set(manifest.files) == set(BUNDLE_FILES) - {VIEW_ONNX, VIEW_WEIGHTS, OBJECTS_ONNX, DETECTOR_ONNX}
        for name, entry in manifest.files.items():
            assert len(opened_bundle.read(name)) == entry.bytes
        assert manifest.training["parity_max_abs_difference"] < PARITY_TOLERANCE == 1e-4
        assert TrainConfig.from_dict(manifest.training["config"]) == TINY
        assert manifest.training["layout"]["steps"] == TINY.layout.steps

    def test_onnx_and_torch_agree_on_layout_latents(
        self, opened_bundle: Bundle, encoders: PhotographEncoder, optimiser: PoseRefiner
    ) -> None:
        # More than one batch shows that no batch size is fixed.
        scene = scene_of(crooked_flat(), 300, 0)
        latents, profile_m = encoders.layouts.poses(scene.plan, scene.poses, scene.heading, 1.5)
        assert profile_m.shape == (300, opened_bundle.manifest.profile_columns)
        assert latents.shape == (300, opened_bundle.manifest.latent_size)
        np.testing.assert_allclose(np.linalg.norm(latents, axis=1), 1.0, atol=1e-5)
        assert_layouts_agree(encoders, optimiser, 300, 32)

    def test_empty_batch_gives_no_latents(self, encoders: PhotographEncoder) -> None:
        assert encoders.layouts.latents(np.empty((0, 32)), np.empty(0), np.empty(0)).shape == (0, 128)

    @pytest.mark.slow
    def test_exported_files_name_no_local_paths(self, tiny_run: Path) -> None:
        for path in (tiny_run / "bundle").iterdir():
            content = path.read_bytes()
            assert b"site-packages" not in content, path.name
            assert b"/lalaloc_core/" not in content, path.name

    def test_large_weights_are_stored_in_half_precision(self, opened_bundle: Bundle) -> None:
        model = onnx.load_from_string(opened_bundle.read(LAYOUT_ONNX))
        large = [t for t in model.graph.initializer if np.prod(t.dims) >= 1024]
        assert large
        assert {t.data_type for t in large} == {onnx.TensorProto.FLOAT16}

    @pytest.mark.slow
    def test_decoder_round_trip(self, tiny_run: Path) -> None:
        bundle = Bundle.open(tiny_run / "bundle")
        weights = Checkpoint.load(tiny_run / "layout.pt", stage="layout").inference_weights["decoder"]
        expected = LayoutDecoder(bundle.manifest.latent_size).eval()
        expected.load_state_dict(weights)
        latent = torch.nn.functional.normalize(torch.randn(3, bundle.manifest.latent_size), dim=1)
        # Half precision has about three digits.
        torch.testing.assert_close(load_decoder(bundle)(latent), expected(latent), rtol=2e-2, atol=2e-2)
        stored = safetensors.torch.load(bundle.read(DECODER_WEIGHTS))
        assert stored["expand.weight"].dtype == torch.float16

    @pytest.mark.slow
    def test_bundle_without_decoder_is_valid(self, tmp_path: Path) -> None:
        bundle = exported_bundle(tmp_path, TINY)
        assert DECODER_WEIGHTS not in bundle.manifest.files
        PhotographEncoder(bundle, threads=1)
        with pytest.raises(BundleError, match=DECODER_WEIGHTS):
            load_decoder(bundle)

    @pytest.mark.slow
    def test_bundle_without_image_encoder_encodes_layouts(self, tmp_path: Path) -> None:
        bundle = export_bundle(tmp_path, TINY, build_layout_encoder(TINY), None, name="half", version="1")
        assert not {IMAGE_ONNX, IMAGE_WEIGHTS} & set(bundle.manifest.files)
        encoders = PhotographEncoder(bundle, threads=1)
        assert encoders.layouts.latents(np.full((1, 32), 2.0), np.array([1.5]), np.array([2.5])).shape == (1, 128)
        with pytest.raises(BundleError, match="layout queries only"):
            encoders.spheres.query(np.zeros((32, 64, 3), dtype=np.uint8), 0.0, CameraHeight(1.5))

    @pytest.mark.slow
    def test_network_that_differs_from_torch_is_not_exported(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(export, "PARITY_TOLERANCE", 0.0)
        with pytest.raises(ExportError, match="differs from torch"):
            exported_bundle(tmp_path / "bundle", TINY)
        assert not (tmp_path / "bundle").exists()

    @pytest.mark.slow
    def test_paper_architecture_is_exported(self, tmp_path: Path) -> None:
        config = small_paper()
        # A file that a bundle of another architecture left behind is not listed.
        (tmp_path / HEAD_ONNX).write_bytes(b"of another architecture")
        bundle = exported_bundle(tmp_path, config)
        assert (bundle.manifest.architecture, bundle.manifest.ring_sectors) == ("paper", 0)
        assert HEAD_ONNX not in bundle.manifest.files
        encoders, optimiser = PhotographEncoder(bundle, threads=1), PoseRefiner.from_bundle(bundle)
        image = np.random.default_rng(0).integers(0, 256, (64, 128, 3), dtype=np.uint8)
        known = encoders.spheres.query(image, 0.0, CameraHeight(1.5))
        assert known.latents.shape == (1, 128)
        # The hypothesis of an eighth turn undoes the turn of the photograph.
        unknown = encoders.spheres.query(np.roll(image, -16, axis=1), None, CameraHeight(1.5))
        eighth = int(np.abs(unknown.roll - np.pi / 4).argmin())
        np.testing.assert_allclose(unknown.latents[eighth], known.latents[0], atol=1e-5)
        scene = scene_of(crooked_flat(), 2, 0)
        assert_layouts_agree(encoders, optimiser, 2, 64)
        assert encoders.layouts.poses(scene.plan, scene.poses, scene.heading, 1.5)[0].shape == (2, 128)


class TestReading:
    @pytest.mark.parametrize("name", [LAYOUT_ONNX, IMAGE_ONNX, HEAD_ONNX, LAYOUT_WEIGHTS])
    def test_altered_file_is_refused(self, bundle_copy: Path, name: str) -> None:
        content = bytearray((bundle_copy / name).read_bytes())
        content[len(content) // 2] ^= 1
        (bundle_copy / name).write_bytes(content)
        bundle = Bundle.open(bundle_copy)
        with pytest.raises(BundleError, match=f"{name}.*SHA-256"):
            PoseRefiner.from_bundle(bundle) if name == LAYOUT_WEIGHTS else PhotographEncoder(bundle)

    def test_missing_file_and_bundle_are_named(self, bundle_copy: Path) -> None:
        (bundle_copy / IMAGE_ONNX).unlink()
        with pytest.raises(BundleError, match=IMAGE_ONNX):
            PhotographEncoder(Bundle.open(bundle_copy))
        with pytest.raises(BundleError, match="no model bundle at"):
            Bundle.open(bundle_copy / "nothing")

    @pytest.mark.parametrize("name", ["other.onnx", "../manifest.json", MANIFEST_NAME])
    def test_only_listed_files_are_read(self, opened_bundle: Bundle, name: str) -> None:
        with pytest.raises(BundleError, match="has no file"):
            opened_bundle.read(name)

    @pytest.mark.parametrize(
        "changes",
        [
            {"colour": "blue"},
            {"format_version": 1},
            {"format_version": None},
            {"files": []},
            {"files": {"head.onnx": {"bytes": 1}}},
            {"files": {"head.onnx": {"bytes": 1, "sha256": "", "md5": ""}}},
            {"confidence": {"bias": 1.0}},
            {"confidence": {"known_heading": {}, "searched_heading": {"lpo": {"bias": 1.0}}}},
            {"confidence": {"known_heading": {}, "searched_heading": {}, "margin": 1.0}},
            {"confidence": "high"},
            {"image_height": "128"},
            {"image_height": 128.5},
            {"latent_size": None},
            {"image_mean": [0.5, "0.5", 0.5]},
            {"name": 3},
        ],
    )
    def test_manifest_with_invalid_entries_is_refused(self, bundle_copy: Path, changes: dict) -> None:
        path = bundle_copy / MANIFEST_NAME
        path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")
        with pytest.raises(BundleError):
            Bundle.open(bundle_copy)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "manifest.json is not JSON"),
            ("{", "manifest.json is not JSON"),
            ("[]", "manifest.json must be a JSON object, not list"),
            ("null", "manifest.json must be a JSON object, not NoneType"),
            ("3", "manifest.json must be a JSON object, not int"),
        ],
    )
    def test_manifest_that_is_no_object_is_refused(self, text: str, message: str) -> None:
        with pytest.raises(BundleError, match=message):
            Manifest.from_json(text)

    @pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
    def test_manifest_numbers_are_finite(self, opened_bundle: Bundle, number: str) -> None:
        raw = json.loads(opened_bundle.manifest.to_json())
        raw["image_mean"] = [0.5, float(number), 0.5]
        with pytest.raises(BundleError, match=r"manifest\.image_mean\[1\] is -?(nan|inf)"):
            Manifest.from_json(json.dumps(raw))

    def test_manifest_without_a_required_key_is_refused(self, opened_bundle: Bundle) -> None:
        raw = json.loads(opened_bundle.manifest.to_json())
        del raw["latent_size"]
        with pytest.raises(BundleError, match="latent_size"):
            Manifest.from_json(json.dumps(raw))

    def test_manifest_round_trip(self, opened_bundle: Bundle) -> None:
        stages = {"retrieval": LOGISTIC, "lpo": dataclasses.replace(LOGISTIC, bias=2.0)}
        confidence = ConfidenceModel(known_heading=stages, searched_heading={"lpo": LOGISTIC}, heading_factor=0.4)
        manifest = dataclasses.replace(opened_bundle.manifest, confidence=confidence)
        assert Manifest.from_json(manifest.to_json()) == manifest


class TestIdentity:
    def test_weights_change_the_digest_and_metrics_and_name_do_not(self, bundle_copy: Path) -> None:
        before = Bundle.open(bundle_copy)
        scored = dataclasses.replace(before.manifest, name="other", metrics={"within_1m": 0.5})
        after = write_manifest(bundle_copy, scored)
        assert after.sha256 == before.sha256 == Bundle.open(bundle_copy).sha256
        (bundle_copy / HEAD_ONNX).write_bytes(b"other")
        assert write_manifest(bundle_copy, before.manifest).sha256 != before.sha256

    @pytest.mark.slow
    def test_export_replaces_an_existing_bundle(self, bundle_copy: Path, opened_bundle: Bundle) -> None:
        replaced = exported_bundle(bundle_copy, TINY)
        assert replaced.sha256 != opened_bundle.sha256
        assert Bundle.open(bundle_copy).sha256 == replaced.sha256
        PhotographEncoder(replaced)

    @pytest.mark.slow
    @pytest.mark.parametrize("architecture", ["ring", pytest.param("trunk", marks=pytest.mark.slow)])
    def test_reexport_rebuilds_networks_from_weights(self, tmp_path: Path, architecture: str) -> None:
        before = exported_bundle(tmp_path, PRESETS["tiny" if architecture == "ring" else "tiny-trunk"])
        manifest = Bundle.open(tmp_path).manifest
        image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        first = PhotographEncoder(before, threads=1).spheres.query(image, None, CameraHeight(1.5))
        for name in (IMAGE_ONNX, LAYOUT_ONNX, HEAD_ONNX):
            model = onnx.load_from_string(before.read(name))
            model.producer_name = "older"
            (tmp_path / name).write_bytes(model.SerializeToString())
        older = write_manifest(tmp_path, manifest)
        after = reexport_bundle(tmp_path)
        assert after.sha256 == Bundle.open(tmp_path).sha256 != older.sha256
        again = PhotographEncoder(after, threads=1).spheres.query(image, None, CameraHeight(1.5))
        np.testing.assert_allclose(again.latents, first.latents, atol=1e-6)
        assert after.manifest.image_config == manifest.image_config
        assert after.manifest.opening_prior == manifest.opening_prior
        for name in set(manifest.files) - {IMAGE_ONNX, LAYOUT_ONNX, HEAD_ONNX}:
            assert after.manifest.files[name] == manifest.files[name]

    def test_reexport_refuses_damaged_weights(self, bundle_copy: Path) -> None:
        (bundle_copy / LAYOUT_WEIGHTS).write_bytes(b"damaged")
        with pytest.raises(BundleError, match=LAYOUT_WEIGHTS):
            reexport_bundle(bundle_copy)


class TestConfidence:
    model = ConfidenceModel(
        known_heading={"vdr": dataclasses.replace(LOGISTIC, bias=0.0), "lpo": LOGISTIC},
        searched_heading={"lpo": dataclasses.replace(LOGISTIC, bias=-1.0)},
    )
    signals: ClassVar = {"log_odds": 1.5, "cost": 0.2, "uncertainty": -3.0, "latent_distance": 0.1}

    @pytest.mark.parametrize(("stage", "known", "bias"), [("lpo", True, 1.0), ("vdr", True, 0.0), ("lpo", False, -1.0)])
    def test_probability_is_the_documented_formula(self, stage: str, known: bool, bias: float) -> None:
        logit = bias + 2.0 * 1.5 - 4.0 * 0.2 - 0.5 * -3.0 - 6.0 * 0.1
        found = self.model.fit_probability(stage, self.signals, heading_known=known)
        assert found == pytest.approx(1.0 / (1.0 + np.exp(-logit)))

    @pytest.mark.parametrize("cost", [0.0, 1e9, -1e9])
    def test_probability_is_bounded(self, cost: float) -> None:
        found = present(self.model.fit_probability("lpo", {**self.signals, "cost": cost}, heading_known=True))
        assert 0.0 <= found <= 1.0


def test_manifest_that_is_not_utf_8_is_named(tmp_path: Path) -> None:
    (tmp_path / MANIFEST_NAME).write_bytes(b'{"name": "\xff"}')
    with pytest.raises(BundleError, match=r"byte 10 of '.*manifest.json' is not UTF-8"):
        Bundle.open(tmp_path)
