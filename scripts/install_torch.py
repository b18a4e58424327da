"""Install the torch that pyproject.toml pins: the CPU build where no GPU is present.

On Linux the plain wheel brings gigabytes of CUDA libraries. The CPU build has the local version `+cpu` and lies in an
index of its own: pip finds it when it is configured with that index (or with a folder of wheels), or when the
environment variable TORCH_INDEX names it. torch.lock has the digests of these builds. Another build of the version is
installed with a warning, unless TORCH_LOCKED=1; where pip finds none, the plain wheel is, and this script says so.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_CPU = "+cpu"


def main() -> int:
    """Install, unless the right build is there already; the exit status is pip's."""
    version = pinned_version((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    # Elsewhere than on Linux the plain wheel is the CPU build.
    wants_cpu = sys.platform == "linux" and not has_gpu()
    if is_installed(version, wants_cpu=wants_cpu):
        return 0
    if wants_cpu:
        print(f"install_torch: no GPU here, looking for the CPU build torch=={version}{_CPU}", flush=True)
        status = pip_install(f"torch=={version}{_CPU}", locked=True)
        if status == 0 or os.environ.get("TORCH_LOCKED") == "1":
            return status
        print("install_torch: no CPU build with a digest of torch.lock, looking for another one", file=sys.stderr)
        if pip_install(f"torch=={version}{_CPU}") == 0:
            return 0
        print(
            f"install_torch: pip found no CPU build of torch {version}; installing the plain one, which works here as "
            "well but may bring gigabytes of CUDA libraries. To avoid them, set TORCH_INDEX to the address of "
            "PyTorch's CPU wheel index and start again.",
            file=sys.stderr,
            flush=True,
        )
    return pip_install(f"torch=={version}")


def pinned_version(pyproject: str) -> str:
    """Return the version in the only `torch==` requirement of a pyproject.toml."""
    extras = tomllib.loads(pyproject)["project"]["optional-dependencies"]
    requirements = [requirement for extra in extras.values() for requirement in extra]
    versions = {match[1] for requirement in requirements if (match := re.fullmatch(r"torch==([\w.]+)", requirement))}
    (version,) = versions
    return version


def has_gpu() -> bool:
    """Return true if an NVIDIA driver answers and lists a GPU."""
    try:
        listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, timeout=30, check=True, text=True)
    except (OSError, subprocess.SubprocessError):
        return False
    return "GPU" in listing.stdout


def is_installed(version: str, *, wants_cpu: bool) -> bool:
    """Return true if this environment has the version; without a GPU any build of it suffices."""
    try:
        installed = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return False
    if installed.partition("+")[0] != version:
        return False
    return wants_cpu or not installed.endswith(_CPU)


def pip_install(requirement: str, *, locked: bool = False) -> int:
    """Install one requirement into the running environment; pip's exit status.

    `locked` accepts only files with a digest of torch.lock, and installs no dependencies, which other locks have.
    """
    index = os.environ.get("TORCH_INDEX")
    options = ["--extra-index-url", index] if index else []
    command = [sys.executable, "-m", "pip", "install", "-qq", "--disable-pip-version-check", *options]
    if not locked:
        constraints = ["-c", str(ROOT / "constraints.txt")]
        return subprocess.run([*command, *constraints, requirement], check=False).returncode
    lock = (ROOT / "torch.lock").read_text(encoding="utf-8")
    digests = re.findall(r"^--hash=sha256:[0-9a-f]{64}", lock, re.MULTILINE)
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
        file.write(" ".join([requirement, *digests]))
        file.flush()
        return subprocess.run([*command, "--no-deps", "--require-hashes", "-r", file.name], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
