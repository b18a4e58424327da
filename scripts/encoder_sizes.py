"""Which width and input size of the `ring` image encoder is worth its time, at equal CPU time of training.

Renders a pool of panoramas once, trains every variant from scratch on it against the layout encoder of a bundle, two at
a time with one thread each, and prints a table: parameters, panoramas seen, latency of the exported network with two
threads, how often the nearest pose of the 0.5 m grid lies within 1 m and 50 cm and its median error by latent, by wall
profile, by the profile's likelihood and by latent and profile together, and the mean |error of log distance|. The
panoramas scored are of validation homes.

    python -m scripts.encoder_sizes --pool POOL --textures TEXTURES --minutes 6 --out encoder_sizes.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from lalaloc_core.learn.training.averaging import moving_average
from lalaloc_core.learn.training.config import OptimiserConfig
from lalaloc_core.learn.training.loop import learning_rate
from lalaloc_core.learn.training.presets import PRESETS
from lalaloc_core.learn.training.stages import build_optimiser
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.nets.layout_encoder import RingConfig, RingLayoutEncoder
from scripts.encoder_ideas import ContrastiveStage, DenseStage, Gru, RingStage
from scripts.encoder_pool import BUNDLE, FULL_HEIGHT, FULL_WIDTH, PROCESSES, Pool, render_pool, teacher_of


@dataclass(frozen=True)
class Variant:
    """What differs from the preset: sizes, settings of stage 2, seed, the stage's class and the mixer's."""

    ring: dict[str, Any] = field(default_factory=dict)
    image: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    stage: type[RingStage] = RingStage
    mixer: Callable[[RingConfig], nn.Module] | None = None

    def build(self, teacher: RingLayoutEncoder) -> RingStage:
        """The stage with a fresh image encoder."""
        torch.manual_seed(self.seed)
        optimiser = OptimiserConfig(learning_rate=1.5e-3)
        image = dataclasses.replace(PRESETS["ring"].image, ema_decay=0.99, optimiser=optimiser, **self.image)
        ring = dataclasses.replace(PRESETS["ring"].ring, **self.ring)
        stage = self.stage(dataclasses.replace(PRESETS["ring"], ring=ring, image=image), teacher)
        if self.mixer is not None:
            stage.ring_encoder.mixer = nn.Sequential(self.mixer(ring))
        return stage


def _full(stem: int, *widths: int) -> Variant:
    sizes = {"image_height": FULL_HEIGHT, "image_width": FULL_WIDTH, "image_blocks": (1, 1, 2, 2, 2)}
    return Variant({**sizes, "image_stem": stem, "image_widths": widths})


VARIANTS = {
    "middle": Variant(),
    "narrow": Variant({"image_stem": 16, "image_widths": (20, 36, 56, 72)}),
    "wide": Variant({"image_stem": 32, "image_widths": (48, 84, 132, 168)}),
    "narrow-256": _full(12, 12, 20, 36, 56, 72),
    "middle-256": _full(16, 16, 32, 56, 88, 112),
    "wide-256": _full(24, 24, 48, 84, 132, 168),
    "middle, seed 1": Variant(seed=1),
    "no mixer": Variant({"mixer_blocks": 0}),
    "gru": Variant(mixer=Gru),
    "profile weight 1": Variant(image={"profile_weight": 1.0}),
    "dense head": Variant(stage=DenseStage),
    "contrastive": Variant(stage=ContrastiveStage),
}


def train(stage: RingStage, pool: Pool, minutes: float, seed: int) -> tuple[nn.Module, int]:
    """Train for some CPU minutes, making batches excluded; returns the averaged encoder and the panoramas seen."""
    settings, encoder = stage.settings, stage.ring_encoder
    optimiser = build_optimiser(stage.modules, settings.optimiser)
    parameters = [p for module in stage.modules.values() for p in module.parameters()]
    averaged, spent, steps = moving_average(encoder, settings.ema_decay), 0.0, 0
    for batch in pool.batches(settings.batch, seed):
        begin = time.process_time()
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(settings.optimiser, min(spent / (60.0 * minutes), 1.0))
        total = torch.stack(list(stage.losses(batch).values())).sum()
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(parameters, settings.optimiser.clip_norm)
        optimiser.step()
        steps += 1
        averaged.update_parameters(encoder)
        spent += time.process_time() - begin
        if spent > 60.0 * minutes:
            break
    return averaged.module, steps * settings.batch


@torch.no_grad()
def score(encoder: nn.Module, head: nn.Module, folder: Path, height: int) -> dict[str, Any]:
    """Accuracy of the nearest grid pose by each distance, over the validation panoramas."""
    images, facts = np.load(folder / f"validation-{height}.npy"), dict(np.load(folder / "validation.npz"))
    rows = [np.split(facts[key], np.cumsum(facts["grid_count"])[:-1]) for key in _GRID_KEYS]
    errors: dict[str, list[float]] = {}
    log_errors, seen = [], []
    inputs = (torch.from_numpy(images).split(16), torch.from_numpy(facts["camera_m"]).split(16))
    for image, camera in zip(*inputs, strict=True):
        features = encoder(image, camera)
        parts = (head(features.ring), features.log_profile, features.log_scale)
        seen += list(zip(*(part.numpy() for part in parts), strict=True))
    for (latent, log_profile, log_scale), profile, *grid in zip(seen, facts["profile_m"], *rows, strict=True):
        grid_profile, grid_latent, grid_error = grid
        off = np.minimum(np.abs(np.log(grid_profile) - log_profile), 0.7)
        by_latent, by_profile = np.linalg.norm(grid_latent - latent, axis=1), off.mean(axis=1)
        distances = {
            "latent": by_latent,
            "profile": by_profile,
            "likelihood": (off * np.exp(-log_scale)).mean(axis=1),
            "both": by_latent / np.median(by_latent) + by_profile / np.median(by_profile),
        }
        for name, distance in distances.items():
            errors.setdefault(name, []).append(float(grid_error[distance.argmin()]))
        log_errors.append(np.abs(np.log(profile[0]) - log_profile).mean())
    scores: dict[str, Any] = {"mean_abs_log_error": float(np.mean(log_errors))}
    for name, values in errors.items():
        e = np.array(values)
        within = {f"within_{limit}": float((e < limit / 100).mean()) for limit in (100, 50)}
        scores[name] = {**within, "median_cm": 100.0 * float(np.median(e))}
    return scores


_GRID_KEYS = ("grid_profile_m", "grid_latent", "grid_error_m")


class _Outputs(nn.Module):
    """The encoder's features as a plain tuple, which is what ONNX knows."""

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, image: Tensor, camera_height_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        features = self.encoder(image, camera_height_m)
        return features.ring, features.log_profile, features.log_scale


def run(task: tuple[str, Path, float]) -> tuple[str, dict[str, Any]]:
    """Train, score and export one variant."""
    name, folder, minutes = task
    torch.set_num_threads(1)
    variant, teacher = VARIANTS[name], teacher_of(Bundle.open(BUNDLE))
    stage = variant.build(teacher)
    ring = stage.config.ring
    encoder, panoramas = train(stage, Pool.open(folder, ring.image_height), minutes, variant.seed)
    image = torch.zeros(1, ring.image_height, ring.image_width, 3, dtype=torch.uint8)
    torch.onnx.export(_Outputs(encoder), (image, torch.ones(1)), str(folder / f"{name}.onnx"), dynamo=True)
    return name, {
        "input": f"{ring.image_height}x{ring.image_width}",
        "widths": [ring.image_stem, *ring.image_widths],
        "parameters": sum(p.numel() for p in encoder.parameters()),
        "panoramas": panoramas,
        **score(encoder, teacher.head, folder, ring.image_height),
    }


def latency_ms(path: Path, repeats: int = 60) -> float:
    """Median time of one panorama through an exported encoder with two threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 2
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    image, camera = session.get_inputs()
    feed = {image.name: np.full(image.shape, 128, np.uint8), camera.name: np.ones(1, np.float32)}
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        session.run(None, feed)
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times[repeats // 6 :]))


def table(results: dict[str, dict[str, Any]]) -> str:
    """The results as Markdown."""
    kinds = ("latent", "profile", "likelihood", "both")
    lines = [
        "| variant | input | parameters | panoramas | ms | "
        + " | ".join(f"{kind}: < 1 m, < 50 cm, median" for kind in kinds)
        + " | mean abs. log error |",
        "|" + "---|" * (6 + len(kinds)),
    ]
    for name, r in results.items():
        cells = [name, r["input"], f"{r['parameters']:,}", f"{r['panoramas']:,}", f"{r.get('latency_ms', 0):.1f}"]
        for kind in kinds:
            s = r[kind]
            cells.append(f"{s['within_100']:.1%}, {s['within_50']:.1%}, {s['median_cm']:.0f} cm")
        lines.append("| " + " | ".join([*cells, f"{r['mean_abs_log_error']:.3f}"]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="results as JSON; variants already there are kept")
    parser.add_argument("--pool", type=Path, required=True, help="folder of the rendered pool, about 3 GB")
    parser.add_argument("--textures", type=Path, required=True, help="folder of material pictures")
    parser.add_argument("--minutes", type=float, default=6.0, help="CPU minutes of training per variant")
    parser.add_argument("--only", nargs="*", choices=VARIANTS, default=list(VARIANTS), help="variants to train")
    options = parser.parse_args()
    render_pool(options.pool, options.textures)
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    tasks = [(name, options.pool, options.minutes) for name in options.only]
    with multiprocessing.get_context("spawn").Pool(PROCESSES, maxtasksperchild=1) as pool:
        for name, result in pool.imap_unordered(run, tasks):
            results[name] = {"cpu_minutes": options.minutes, **result}
            options.out.write_text(json.dumps(results, indent=2) + "\n")
    for name, result in results.items():
        if (options.pool / f"{name}.onnx").exists():
            result["latency_ms"] = latency_ms(options.pool / f"{name}.onnx")
    options.out.write_text(json.dumps(results, indent=2) + "\n")
    print(table(results))


if __name__ == "__main__":
    main()
