"""The tiny bundle: both stages of the preset `tiny`, trained for seconds, and an encoder of views with random weights.

`tests/tiny.zip` has it, because training takes as long as a hundred tests; `python -m tests.tiny` trains it again.
`tests/core/test_tiny.py` compares it with the code that trains it.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
import shutil
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import safetensors.torch
import torch

from lalaloc_core.bundle import DECODER_WEIGHTS, Bundle, write_manifest
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.nets.layout_network import LayoutDecoder

COMMITTED = Path(__file__).parent / "tiny.zip"
_ROOT = Path(__file__).parents[1]
# Modules whose imports are all that trains and exports the bundle.
_TRAINING = ("lalaloc_core.learn.training.run", "lalaloc_core.learn.export.run_export")
_DIGEST, _PLAIN, _VIEWS = "trained_from", "bundle", "views"
# Zip files state times; all are the same, so that equal content gives equal files.
_WRITTEN = (1980, 1, 1, 0, 0, 0)


def train(folder: Path) -> Path:
    """Train both stages in `folder`, in about 30 s, and return the exported bundle."""
    from lalaloc_core.learn.export.run_export import export_run
    from lalaloc_core.learn.training.run import train_stage
    from lalaloc_core.learn.training.training_data import TrainingData

    torch.set_num_threads(1)
    device = torch.device("cpu")
    # Rendering the usual number of validation spheres would take longer than the training.
    data = TrainingData(validation_scenes=2)
    train_stage("layout", PRESETS["tiny"], folder, device=device, data=data, workers=0)
    train_stage("image", PRESETS["tiny"], folder, device=device, data=data, workers=0)
    return export_run(folder, folder / "bundle", name="tiny", version="test").folder


def unpack(folder: Path, *, views: bool = False) -> Path:
    """Write the committed bundle to `folder`, with the encoder of views or without."""
    with zipfile.ZipFile(COMMITTED) as archive:
        for part in (_PLAIN, _VIEWS) if views else (_PLAIN,):
            for entry in archive.namelist():
                if entry.startswith(f"{part}/"):
                    (folder / Path(entry).name).write_bytes(archive.read(entry))
    # The decoder would be as large as all the rest five times; no test needs a trained one.
    torch.manual_seed(0)
    weights = LayoutDecoder().state_dict()
    half = {name: value.half() if value.numel() >= 1024 else value for name, value in weights.items()}
    (folder / DECODER_WEIGHTS).write_bytes(safetensors.torch.save(half))
    return write_manifest(folder, Bundle.open(folder).manifest).folder


def configuration() -> str:
    return json.dumps(dataclasses.asdict(PRESETS["tiny"]), sort_keys=True, default=str)


def committed(name: str) -> str:
    """Return a text of the committed file: `trained_from` or `configuration`."""
    with zipfile.ZipFile(COMMITTED) as archive:
        return archive.read(name).decode()


@cache
def trained_from() -> str:
    """Return the digest of the code that trains the bundle; comments, docstrings and layout of lines do not count."""
    waiting, code = list(_TRAINING), {}
    while waiting:
        path = _file_of(waiting.pop())
        if path is None or path in code:
            continue
        tree = ast.parse(path.read_bytes())
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                waiting += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        code[path] = ast.dump(tree)
    return hashlib.sha256("".join(code[path] for path in sorted(code)).encode()).hexdigest()


def _file_of(module: str) -> Path | None:
    """Return the file of a module of the core; None for other modules and for names in modules."""
    path = _ROOT.joinpath(*module.split("."))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in candidates if file.is_file()), None) if module.startswith("lalaloc_core") else None


def write() -> None:
    """Train the bundle and write the committed file."""
    from lalaloc_core.learn.export.bundle_export import add_view_encoder
    from lalaloc_core.nets.view_network import ViewNetwork

    config = PRESETS["tiny"]
    with tempfile.TemporaryDirectory() as scratch:
        plain = train(Path(scratch))
        views = Path(scratch) / "views"
        shutil.copytree(plain, views)
        torch.manual_seed(0)
        add_view_encoder(Bundle.open(views), config, ViewNetwork(config.view, config.ring), {})
        entries = {_DIGEST: trained_from().encode(), "configuration": configuration().encode()}
        for name, folder in ((_PLAIN, plain), (_VIEWS, views)):
            for path in sorted(folder.iterdir()):
                content = path.read_bytes()
                if path.name != DECODER_WEIGHTS and content != entries.get(f"{_PLAIN}/{path.name}"):
                    entries[f"{name}/{path.name}"] = content
    with zipfile.ZipFile(COMMITTED, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, _WRITTEN), content, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    write()
