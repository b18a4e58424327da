"""Install every package of a lock by its digest, with a progress bar.

    python scripts/install_lock.py serving.lock

The packages come by uv, which takes a tenth of pip's time and is in the lock itself, or by pip, where only pip is
configured for a mirror. Both print errors only.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent
# Few parts, so that each downloads in parallel, but enough of them to show progress.
_PARTS = 8
_BAR = 30


def blocks(text: str) -> dict[str, str]:
    """Return the requirements of a lock by name, each with its digests."""
    found = re.findall(r"^(?:[A-Za-z0-9][\w.-]*)(?:\[[^\]]*\])?==[^\n]*\n(?:    [^\n]*\n)*", text, re.MULTILINE)
    return {re.split(r"[\[=]", block)[0]: block for block in found}


def main() -> int:
    """Install the lock that is named on the command line; the exit status is that of the last installer."""
    (lock,) = sys.argv[1:]
    wanted = blocks((_ROOT / lock).read_text(encoding="utf-8"))
    names = list(wanted)
    _show(0, len(names))
    if install(_pip(), wanted["uv"]) != 0:
        return 1
    for part in range(_PARTS):
        chosen = names[part::_PARTS]
        text = "".join(wanted[name] for name in chosen)
        if install(_uv(), text, quietly=True) != 0 and install(_pip(), text) != 0:
            print(f"install_lock: {lock} was not installed; see above", file=sys.stderr)
            return 1
        _show(sum(len(names[i::_PARTS]) for i in range(part + 1)), len(names))
    return 0


def install(command: list[str], requirements: str, *, quietly: bool = False) -> int:
    """Run an installer on requirements with digests; its exit status. `quietly` drops its errors."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
        file.write(requirements)
        file.flush()
        stderr = subprocess.DEVNULL if quietly else None
        command = [*command, "--no-deps", "--require-hashes", "-r", file.name]
        return subprocess.run(command, stderr=stderr, check=False).returncode


def _pip() -> list[str]:
    return [sys.executable, "-m", "pip", "install", "-qq"]


def _uv() -> list[str]:
    return [str(Path(sys.executable).with_name("uv")), "pip", "install", "-q", "--python", sys.executable]


def _show(done: int, total: int) -> None:
    """Draw the bar over itself on a terminal; elsewhere, print its end only."""
    filled = _BAR * done // total
    text = f"[{'#' * filled}{'.' * (_BAR - filled)}] {done} of {total} packages"
    if sys.stdout.isatty():
        print(f"\r{text}", end="\n" if done == total else "", flush=True)
    elif done == total:
        print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
