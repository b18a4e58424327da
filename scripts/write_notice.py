"""Write the licences of all that ships into NOTICE: the packages of the image, and those in the web pages.

    make notice

The licence is that of a package's metadata; a package that is not installed here keeps the line that NOTICE has of this
version.
"""

from __future__ import annotations

import importlib.metadata
import json
import re
import sys
from pathlib import Path

from lalaloc_core.files import atomic_write
from scripts.write_locks import blocks

ROOT = Path(__file__).resolve().parent.parent
NOTICE = ROOT / "NOTICE"
LOCK = ROOT / "docker" / "requirements.lock"
_BEGIN, _END = "Packages of the image, by its lock:\n", "\nThe web pages contain:\n"
_CLASSIFIER = "License :: "
# A licence is a name of the field `License`, and not a text.
_MAX_NAME = 60


def packages() -> dict[str, str]:
    """Return name and version of the packages in the image; torch has a lock of its own."""
    locked = {
        name: re.split(r"[ \\]", block.split("==")[1])[0]
        for name, block in blocks(LOCK.read_text()).items()
        # The image runs on Linux.
        if "sys_platform == 'win32'" not in block
    }
    (torch,) = set(re.findall(r'"torch==([\w.]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    return dict(sorted((locked | {"torch": torch}).items()))


def licence_of(name: str) -> str | None:
    """Return the licence in the metadata of an installed package; None if it is not installed."""
    try:
        metadata = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        return None
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    classifiers = [text for text in metadata.get_all("Classifier") or [] if text.startswith(_CLASSIFIER)]
    named = [text.split(" :: ")[-1] for text in classifiers if text.count(" :: ") > 1]
    text = metadata["License"].strip() if "License" in metadata else ""
    if text and "\n" not in text and len(text) <= _MAX_NAME:
        return text
    return ", ".join(named) or (text.splitlines()[0][:_MAX_NAME] if text else "see its files")


def notice_text() -> str:
    text = NOTICE.read_text(encoding="utf-8")
    before, _, rest = text.partition(_BEGIN)
    listed, _, after = rest.partition(_END)
    lines = []
    for name, version in packages().items():
        begin = f"    {name} {version}: "
        known = [line for line in listed.splitlines() if line.startswith(begin)]
        licence = licence_of(name)
        if licence is None and not known:
            raise ValueError(f"{name} {version} is neither installed nor listed in NOTICE: install it first")
        lines.append(known[0] if licence is None else begin + licence)
    pages = [f"    {name} {version}: {licence}" for name, version, licence in npm_packages()]
    # Up to the next empty line: the list of the pages.
    after = after.partition("\n\n")[2] if after else ""
    return f"{before}{_BEGIN}" + "\n".join(lines) + f"\n{_END}" + "\n".join(pages) + "\n\n" + after


def npm_packages() -> list[tuple[str, str, str]]:
    """Return name, version and licence of the npm packages that the web pages contain."""
    lock = json.loads((ROOT / "web" / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    found = [(name, lock[f"node_modules/{name}"]) for name in lock[""]["dependencies"]]
    return [(name, package["version"], package["license"]) for name, package in found]


def main() -> int:
    atomic_write(NOTICE, notice_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
