"""Detection of a data set's format by its files."""

from __future__ import annotations

from pathlib import Path

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs, annotation_files
from lalaloc_core.learn.data.dataset import Dataset
from lalaloc_core.learn.data.folder import PLAN_FILE, OwnData
from lalaloc_core.learn.data.posed_spheres import VIEWS_FILE, PosedSpheres, is_posed, room_names
from lalaloc_core.learn.data.structured3d import Structured3D
from lalaloc_core.learn.data.zind import DATA_FILE, PARTITION_FILE, Zind
from lalaloc_core.learn.dataset_names import DATASET_FORMATS

_STRUCTURED3D_SCENES = "scene_" + 5 * "[0-9]"


def open_dataset(root: Path, dataset_format: str | None = None) -> Dataset:
    """Open the data set in a folder; the format is a key of `DATASET_FORMATS`, or None to detect it."""
    if not root.exists():
        raise DatasetError("the folder does not exist", path=root)
    if not root.is_dir():
        raise DatasetError("a data set must be a folder; this is a file", path=root)
    found: dict[str, Dataset] = {}
    if any(path.is_dir() and not (path / PLAN_FILE).exists() for path in root.glob(_STRUCTURED3D_SCENES)):
        found["Structured3D"] = Structured3D(root)
    if (root / PARTITION_FILE).exists() or next(root.glob(f"*/{DATA_FILE}"), None) is not None:
        found["ZInD"] = Zind(root)
    if next(root.glob(f"*/{PLAN_FILE}"), None) is not None:
        found["own data"] = OwnData(root)
    # Path-traced rooms are posed spheres; as annotated photographs, each is asked for in a gallery of rooms.
    if annotation_files(root) or (dataset_format == "annotated" and room_names(root)):
        found["annotated photographs"] = AnnotatedPhotographs(root)
    if is_posed(root):
        found["posed spheres"] = PosedSpheres(root)
    if dataset_format is not None:
        wanted = DATASET_FORMATS[dataset_format]
        if wanted not in found:
            raise DatasetError(f"no {wanted} in this folder; found: {', '.join(found) or 'nothing known'}", path=root)
        return found[wanted]
    if len(found) > 1:
        raise DatasetError(f"the folder holds several data sets: {', '.join(found)}; name the format", path=root)
    if not found:
        raise DatasetError(
            "no data set in this folder; looked for folders 'scene_00000' (Structured3D), "
            f"'{PARTITION_FILE}' or '*/{DATA_FILE}' (ZInD), '*/{PLAN_FILE}' (own data), "
            f"'*.json' with 'photograph' and 'polygon' (annotated photographs), and '{VIEWS_FILE}' or '<seed>.json' "
            "(posed spheres)",
            path=root,
        )
    return next(iter(found.values()))
