"""Small plan files that are made to take an import worker's time or memory, and what each of them takes.

    python -m benchmarks.hostile_plans
    python -m benchmarks.hostile_plans --only roomplan --bytes 100000

Prints a Markdown table of CPU time and memory, each measured in a process of its own with the service's limits. The
exit status is 1 when a file takes longer or more than it may for its size, or ends its process.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import re
import resource
import sys
import time
from multiprocessing.connection import Connection

from benchmarks.harness import argument_parser, print_table_head, table_row
from benchmarks.hostile_drawings import DRAWINGS
from benchmarks.hostile_models import MODELS, PICTURES
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.importers import ImportLimits, import_plans
from service.settings import Settings
from service.workers.process import limit_memory

# CPU time that a file may take: the libraries of its format, and its content.
MAX_S, MAX_S_PER_100_KB = 4.0, 4.0
_WALL_TIMEOUT_S = 300.0

HOSTILE_PLANS = (*MODELS, *DRAWINGS, *PICTURES)


def _measure_here(number: int, size: int, pipe: Connection) -> None:
    plan, settings = HOSTILE_PLANS[number], Settings()
    content = plan.make(size)
    resource.setrlimit(resource.RLIMIT_CPU, (120, 121))
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    begin_s = time.process_time()
    limit_memory(settings.imports.memory_bytes)
    pipe.send(len(content))
    try:
        plans = import_plans(content, plan.options, ImportLimits())
        outcome = f"{sum(len(plan.document['rooms']) for plan in plans)} rooms"
    except InvalidInputError as error:
        outcome = str(error)
    except MemoryError:
        outcome = "MemoryError"
    except Exception as error:
        outcome = f"FAULT {type(error).__name__}: {error}"
    used_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    pipe.send((time.process_time() - begin_s, used_mb, outcome))


def measure(number: int, size: int) -> tuple[int, float, float, str]:
    """Import a file in a process of its own; return its bytes, CPU time (s), memory (MB) and the result in words."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_measure_here, args=(number, size, theirs))
    process.start()
    theirs.close()
    begin_s = time.monotonic()
    bytes_sent = 0
    try:
        bytes_sent = ours.recv()
        if not ours.poll(_WALL_TIMEOUT_S):
            process.kill()
            raise EOFError
        seconds, memory_mb, outcome = ours.recv()
    except EOFError:
        process.join()
        seconds, memory_mb = time.monotonic() - begin_s, math.nan
        outcome = f"process ended with {process.exitcode}"
    process.join()
    return bytes_sent, seconds, memory_mb, outcome


def main() -> int:
    """Measure all files; return 1 when one takes too long."""
    parser = argument_parser(__doc__)
    parser.add_argument("--only", default="", help="measure the files whose 'format, content' match this expression")
    parser.add_argument("--bytes", type=int, default=100_000, help="approximate size of a file")
    options = parser.parse_args()
    print_table_head("format", "content", "bytes", "CPU", "memory", "result")
    failed = False
    for number, plan in enumerate(HOSTILE_PLANS):
        if not re.search(options.only, f"{plan.format}, {plan.title}"):
            continue
        size, seconds, memory_mb, outcome = measure(number, options.bytes)
        is_slow = seconds > MAX_S + MAX_S_PER_100_KB * size / 1e5
        failed |= is_slow or outcome.startswith(("FAULT", "process"))
        shown = f"{'SLOW ' * is_slow}{outcome[:150]}"
        print(
            table_row(plan.format, plan.title, f"{size:,}", f"{seconds:.1f} s", f"{memory_mb:.0f} MB", shown),
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
