"""Localise a photograph in a floor plan.

`LaLaLoc` and `read_plan` (`api.py`) are the interface for other programs; [promises](../docs/reference/promises.md)
say what stays. The query side below it:

    floorplan/   plans: rooms, openings, anchors, validation
    importers/   import and export of plan files of other tools
    bundle/      the model bundle: manifest, fitted parameters, files
    photograph/  photographs as files: decoding, metadata, levelling
    render/      the layout renderer
    nets/        the networks in torch
    localise/    encoders, matching cost, retrieval, VDR, LPO, posterior, answers
    draw/        pictures of plans and answers

`learn/` trains models, `evaluate/` measures them, `cli/` is the command line. All of them use `conventions.py` (axes,
units, pixels), `errors.py`, `files.py`, `file_kinds.py` and `configuration.py` (dataclasses from plain data).

Begin with `localise/search/pipeline.py`, the path of a query. Importing this package loads none of its modules;
importing a name from it does, but neither torch nor a network.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lalaloc_core.api import (
        Answer,
        FloorPlan,
        LaLaLoc,
        Odometry,
        PinnedAlbum,
        StatedCamera,
        Track,
        TrackedAnswer,
        TurnAnswer,
        read_plan,
    )
    from lalaloc_core.errors import LaLaLocError

__version__ = "0.18.0"
__all__ = [
    "Answer", "FloorPlan", "LaLaLoc", "LaLaLocError", "Odometry", "PinnedAlbum", "StatedCamera", "Track",
    "TrackedAnswer", "TurnAnswer", "read_plan",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Load what is exported when it is used first: commands that localise nothing stay fast."""
    if name not in __all__:
        raise AttributeError(f"module 'lalaloc_core' has no attribute '{name}'")
    from importlib import import_module

    module = "lalaloc_core.errors" if name == "LaLaLocError" else "lalaloc_core.api"
    return getattr(import_module(module), name)
