"""Write the locks: the pins of constraints.txt with the digests of their files, for every platform.

    make lock

`requirements.lock` is all that `make setup` installs, `docker/requirements.lock` all that the image contains. torch is
in neither: its build depends on the machine, so `torch.lock` has the digests of the CPU builds, and
`scripts/install_torch.py` installs it. Needs uv, which `make lock` installs beside the environment.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from lalaloc_core.files import atomic_write

ROOT = Path(__file__).resolve().parent.parent
# Lock -> what contains the extras that it is for, and the expression that finds them.
LOCKS = {
    "requirements.lock": ("scripts/setup.sh", r'^extras="([\w,]+)"$'),
    "docker/requirements.lock": ("docker/Dockerfile", r"^ARG EXTRAS=([\w,]+)$"),
}
# torch, and the libraries that only its CUDA build needs.
_OF_TORCH = re.compile(r"torch|triton|(cuda|nvidia)-.*")
_HEAD = "# Written by `make lock` from pyproject.toml and constraints.txt; do not edit.\n"


def extras_of(lock: str) -> list[str]:
    """Return the extras that a lock is for."""
    file, pattern = LOCKS[lock]
    (extras,) = re.findall(pattern, (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)
    return extras.split(",")


def blocks(text: str) -> dict[str, str]:
    """Return the requirements of a lock by name, each with its digests."""
    found = re.findall(r"^(?:[A-Za-z0-9][\w.-]*)(?:\[[^\]]*\])?==[^\n]*\n(?:    [^\n]*\n)*", text, re.MULTILINE)
    return {re.split(r"[\[=]", block)[0]: block for block in found}


def main() -> int:
    """Write all locks with the uv that is named on the command line."""
    (uv,) = sys.argv[1:]
    options = ["--universal", "--python-version", "3.11.5", "--generate-hashes", "--no-header", "--no-annotate"]
    for lock in LOCKS:
        extras = [word for extra in extras_of(lock) for word in ("--extra", extra)]
        command = [uv, "pip", "compile", "pyproject.toml", "-c", "constraints.txt", *options, *extras]
        done = subprocess.run([*command, "--no-emit-index-url", "--quiet"], cwd=ROOT, capture_output=True, text=True)
        if done.returncode != 0:
            print(f"write_locks: {lock}: {done.stderr}", file=sys.stderr)
            return 1
        kept = [block for name, block in blocks(done.stdout).items() if not _OF_TORCH.fullmatch(name)]
        atomic_write(ROOT / lock, _HEAD + "".join(kept))
    return 0


if __name__ == "__main__":
    sys.exit(main())
