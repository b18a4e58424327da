"""Atomic writing of files, and the folder of the model that ships; finding it reads no bundle."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PART_SUFFIX = ".part"
MANIFEST_NAME = "manifest.json"
# In a checkout, and in an installation.
_CHECKOUT = Path("models/default")
_INSTALLED = Path("share/lalaloc/models/default")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it at the end; after an error `path` is unchanged.

    A process killed meanwhile leaves the previous file, and the temporary file beside it.
    """
    part = path.with_name(path.name + PART_SUFFIX)
    try:
        yield part
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def atomic_write(path: Path, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8."""
    with replacing(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


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
