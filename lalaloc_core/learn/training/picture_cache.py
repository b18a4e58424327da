"""A cache of rendered pictures in a run's folder: validation asks with the same ones every time."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.files import replacing


def cached_pictures(
    path: Path | None, about: list[bytes], make: Callable[[], UInt8[np.ndarray, "n h w 3"]]
) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures from a file, made and written there where it is missing, damaged or of other pictures.

    Args:
        path: an npz file; None keeps nothing.
        about: what tells these pictures from others, such as poses. What renders them is not part of it: delete the
            file to have them rendered anew.
    """
    if path is None:
        return make()
    digest = hashlib.sha256(b"\n".join(about)).hexdigest()
    try:
        with np.load(path) as kept:
            if str(kept["digest"]) == digest:
                return kept["pictures"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        # A file that is missing or damaged is as good as none: its pictures are made again.
        pass
    pictures = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, digest=np.array(digest), pictures=pictures)
    return pictures
