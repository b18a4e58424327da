"""Folder of the model that ships; finding it reads no bundle, so the command line can name it without loading one."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

MANIFEST_NAME = "manifest.json"
# In a checkout, and in an installation.
_CHECKOUT = Path("models/default")
_INSTALLED = Path("share/lalaloc/models/default")


def default_bundle() -> Path:
    """Return the folder of the model that ships: in this checkout, else the installed one.

    If the working folder is the checkout, the path is relative, so that recorded commands work elsewhere.
    """
    checkout = Path(__file__).resolve().parents[1] / _CHECKOUT
    if (checkout / MANIFEST_NAME).is_file():
        return _CHECKOUT if _CHECKOUT.resolve() == checkout else checkout
    from importlib.metadata import PackageNotFoundError, distribution

    with suppress(PackageNotFoundError):
        for file in distribution("lalaloc").files or []:
            path = Path(file.locate()).resolve()
            if path.name == MANIFEST_NAME and path.parent.match(f"*/{_INSTALLED}"):
                return path.parent
    # Opening it raises an error that names the folder.
    return checkout
