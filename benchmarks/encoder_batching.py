"""Would it pay to encode the panoramas of concurrent queries in one batch?

Runs the image encoder of a bundle at several batch sizes and thread counts, and prints images per second of wall clock
and milliseconds of CPU per image. Configurations take turns, so that what else the machine does hits all of them alike;
medians over the turns are compared with batch 1 at the same number of threads.

    python -m benchmarks.encoder_batching --bundle models/default --turns 20
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import onnxruntime

from lalaloc_core.localise.bundle import IMAGE_ONNX, Bundle


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"), help="folder of the model bundle")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 2, 4, 8], help="batch sizes")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="onnxruntime threads")
    parser.add_argument("--turns", type=int, default=20, help="times that every configuration is run")
    arguments = parser.parse_args()

    bundle = Bundle.open(arguments.bundle)
    content = bundle.read(IMAGE_ONNX)
    sessions = {threads: _session(content, threads) for threads in arguments.threads}
    shape = (max(arguments.batches), bundle.manifest.image_height, bundle.manifest.image_width, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    wall_s: dict[tuple[int, int], list[float]] = {}
    cpu_s: dict[tuple[int, int], list[float]] = {}
    for turn in range(arguments.turns + 1):
        for threads, session in sessions.items():
            for batch in arguments.batches:
                taken_s, busy_s = _run(session, images[:batch])
                # The first turn allocates.
                if turn:
                    wall_s.setdefault((threads, batch), []).append(taken_s / batch)
                    cpu_s.setdefault((threads, batch), []).append(busy_s / batch)

    print(f"{bundle.manifest.name} {bundle.manifest.version}, {arguments.turns} turns, medians")
    print("| threads | batch | images/s | ratio | CPU ms/image | ratio |\n|---|---|---|---|---|---|")
    for (threads, batch), times_s in wall_s.items():
        wall, cpu = statistics.median(times_s), statistics.median(cpu_s[threads, batch])
        first = (threads, arguments.batches[0])
        wall_ratio = statistics.median(wall_s[first]) / wall
        cpu_ratio = statistics.median(cpu_s[first]) / cpu
        print(f"| {threads} | {batch} | {1.0 / wall:.1f} | {wall_ratio:.2f} | {cpu * 1e3:.1f} | {cpu_ratio:.2f} |")


def _session(content: bytes, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Spinning would count as work.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def _run(session: onnxruntime.InferenceSession, images: np.ndarray) -> tuple[float, float]:
    """Seconds of wall clock and of CPU that a batch takes."""
    inputs = {}
    for node in session.get_inputs():
        is_image = len(node.shape) == 4
        inputs[node.name] = images if is_image else np.full(len(images), 1.5, np.float32)
    begin, busy = time.perf_counter(), time.process_time()
    session.run(None, inputs)
    return time.perf_counter() - begin, time.process_time() - busy


if __name__ == "__main__":
    main()
