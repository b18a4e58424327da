"""Write the locks: the pins of constraints.txt with the digests of their files, for every platform.

    make lock

`serving.lock` is all that `make setup` installs, `requirements.lock` all of `make develop`, `docker/requirements.lock`
all that the image contains. torch is in none: its build depends on the machine, so `torch.lock` has the digests of the
CPU builds, and `scripts/install_torch.py` installs it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from lalaloc_core.files import atomic_write
from scripts.install_lock import blocks

ROOT = Path(__file__).resolve().parent.parent
# Lock -> what contains the extras that it is for, and the expression that finds them.
LOCKS = {
    "requirements.lock": ("scripts/setup.sh", r'^everything="([\w,]+)"$'),
    "serving.lock": ("scripts/setup.sh", r'^serving="([\w,]+)"$'),
    "docker/requirements.lock": ("docker/Dockerfile", r"^ARG EXTRAS=([\w,]+)$"),
}
# torch, and the libraries that only its CUDA build needs.
_OF_TORCH = re.compile(r"torch|triton|(cuda|nvidia)-.*")
# What installs the packages, and builds this one.
_INSTALLERS = "setuptools\nuv\n"
_HEAD = "# Written by `make lock` from pyproject.toml and constraints.txt; do not edit.\n"


def extras_of(lock: str) -> list[str]:
    file, pattern = LOCKS[lock]
    (extras,) = re.findall(pattern, (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)
    return extras.split(",")


def main() -> int:
    """Write all locks with the uv that is named on the command line."""
    (uv,) = sys.argv[1:]
    options = ["--universal", "--python-version", "3.11.5", "--generate-hashes", "--no-header", "--no-annotate"]
    for lock in LOCKS:
        extras = [word for extra in extras_of(lock) for word in ("--extra", extra)]
        command = [uv, "pip", "compile", "pyproject.toml", "-", "-c", "constraints.txt", *options, *extras]
        needed = "" if lock.startswith("docker/") else _INSTALLERS
        done = subprocess.run(
            [*command, "--no-emit-index-url", "--quiet"], cwd=ROOT, input=needed, capture_output=True, text=True
        )
        if done.returncode != 0:
            print(f"write_locks: {lock}: {done.stderr}", file=sys.stderr)
            return 1
        kept = [block for name, block in blocks(done.stdout).items() if not _OF_TORCH.fullmatch(name)]
        atomic_write(ROOT / lock, _HEAD + "".join(kept))
    return 0


if __name__ == "__main__":
    sys.exit(main())
