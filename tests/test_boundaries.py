"""Tests of the architecture: modules import lower layers only, and the numpy side never loads torch."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Layers of the modules. A module has the layer of its longest listed prefix, and can import from lower layers and from
# its own layer in its own folder. Those of the core: the query side, training and evaluation, lowest first.
CORE_LAYERS = (
    "errors conventions conditions answer_numbers file_kinds files shown_text learn.dataset_names",
    "configuration floorplan learn.metrics",
    "bundle render importers.common learn.synth.records learn.synth.homes",
    "photograph nets importers.drawing learn.synth learn.synth.camera learn.synth.furniture",
    "localise localise.query importers.picture learn.synth.augmentation learn.synth.scene",
    "localise.match importers.formats",
    "localise.encode localise.belief importers",
    "localise.refine",
    "localise.search",
    "localise.localisability localise.venue",
    "localise.tracking localise.album learn.synth.rendering learn.data",
    "localise.answers learn.data.synthetic",
    "localise.local_model draw learn.training evaluate.methods",
    "api evaluate.runs",
    "learn.export learn evaluate.calibrate evaluate.report",
    "evaluate.reproduce evaluate.bench evaluate",
    "cli",
)
LAYERS = {f"lalaloc_core.{name}": index for index, names in enumerate(CORE_LAYERS) for name in names.split()} | {
    # The client imports nothing from the other packages, except to encode photographs, when it is asked to.
    "lalaloc_client": 0,
    "lalaloc_client.on_device": 9,
    "lalaloc_client.asynchronous": 10,
    "lalaloc_client.blocking": 10,
    "lalaloc_client.mcp_server": 11,
}
# Forbidden imports of a package, regardless of layers.
QUERY_SIDE = ("bundle", "floorplan", "importers", "photograph", "render", "nets", "localise", "draw")
FORBIDDEN = {
    **{f"lalaloc_core.{package}": ("lalaloc_core.learn", "lalaloc_core.evaluate") for package in QUERY_SIDE},
    "lalaloc_core.learn": ("lalaloc_core.evaluate",),
    "lalaloc_core": ("lalaloc_client",),
    "service": ("lalaloc_core.learn", "lalaloc_core.evaluate", "lalaloc_core.cli"),
}
# Layers of the service, above the layers of the core, lowest first.
SERVICE_LAYERS = (
    "uploaded_file bounded_cache capacity.fair_share capacity.cpu_accounts capacity.cores",
    "settings errors schemas plan_documents",
    "telemetry query_context",
    "capacity",
    # Programs of worker processes, which do not import their supervisors.
    "workers plan_files.plan_mesh",
    "decoding.decode_worker plan_files.renditions",
    "plan_files.convert_worker storage.migrations",
    "pools storage storage.migrations.versions",
    "grids security decoding plan_files",
    "http venues",
    "query http.middleware",
    "albums query_components",
    "runtime",
    "routes",
    "app openapi",
    "cli",
    "__main__ on_ray",
)
_LOWEST_OF_SERVICE = 30
LAYERS |= {
    f"service.{name}": _LOWEST_OF_SERVICE + index
    for index, names in enumerate(SERVICE_LAYERS)
    for name in names.split()
}
# Only these packages load torch when imported.
_WITH_TORCH = (
    "nets localise.refine.latent_refiner learn.synth learn.data.synthetic learn.training learn.export "
    "evaluate.calibrate evaluate.methods evaluate.runs evaluate.report evaluate.reproduce evaluate.bench"
)
TORCH_PACKAGES = tuple(f"lalaloc_core.{name}" for name in _WITH_TORCH.split())
OURS = ("lalaloc_core", "service", "lalaloc_client")


def _modules() -> dict[str, Path]:
    files = [path for package in OURS for path in sorted((ROOT / package).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


MODULES = _modules()
PACKAGES = {name for name, path in MODULES.items() if path.name == "__init__.py"}


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def _imported(module: str, nodes: Iterator[ast.AST]) -> set[str]:
    """Return the names of the modules that import statements among `nodes` load."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} uses a relative import"
            for alias in node.names:
                deeper = f"{node.module}.{alias.name}"
                found.add(deeper if deeper in MODULES else str(node.module))
    return found


@cache
def _imports(module: str) -> frozenset[str]:
    """Return the names of the modules that all import statements of a module load, those in functions too."""
    return frozenset(_imported(module, ast.walk(_tree(module))))


def _at_import_time(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run at import: not in functions, and not for the type checker only."""
    for child in ast.iter_child_nodes(node):
        lazy = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        typing_only = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
        if not lazy and not typing_only:
            yield child
            yield from _at_import_time(child)


@cache
def _layer(module: str) -> int | None:
    prefixes = [prefix for prefix in LAYERS if module == prefix or module.startswith(prefix + ".")]
    return LAYERS[max(prefixes, key=len)] if prefixes else None


def _folder(module: str) -> str:
    return module if module in PACKAGES else module.rpartition(".")[0]


def _in_torch_package(module: str) -> bool:
    return any(_is_in(module, package) for package in TORCH_PACKAGES)


@cache
def _loaded(module: str) -> frozenset[str]:
    """Return the names of the modules that importing a module loads."""
    loaded = _imported(module, _at_import_time(_tree(module)))
    # Importing a module imports the packages around it.
    return frozenset(loaded | {name.rpartition(".")[0] for name in loaded | {module}})


def _reaches_torch(module: str, seen: set[str]) -> bool:
    seen.add(module)
    loaded = _loaded(module)
    if any(name == "torch" or name.startswith("torch.") for name in loaded):
        return True
    return any(_reaches_torch(name, seen) for name in sorted(loaded) if name in MODULES and name not in seen)


def test_modules_import_from_lower_layers_or_their_folder() -> None:
    wrong = []
    for module in (name for name in MODULES if name not in OURS):
        layer = _layer(module)
        assert layer is not None, f"{module} has no layer yet, add it to LAYERS"
        for target in sorted(_imports(module) - set(OURS)):
            if target.split(".")[0] not in OURS:
                continue
            target_layer = _layer(target)
            assert target_layer is not None, f"{module} imports {target}, which has no layer"
            neighbour = target_layer == layer and _folder(target) == _folder(module)
            if target_layer >= layer and not neighbour:
                wrong.append(f"{module} (layer {layer}) imports {target} (layer {target_layer})")
    assert wrong == []


def _is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def test_forbidden_imports_are_absent() -> None:
    crossing = [
        (module, target)
        for package in FORBIDDEN
        for module in MODULES
        if _is_in(module, package)
        for target in sorted(_imports(module))
        if any(_is_in(target, forbidden) for forbidden in FORBIDDEN[package])
    ]
    assert crossing == []


def test_imports_have_no_cycles() -> None:
    graph = {module: _imports(module) & MODULES.keys() for module in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_package_docstring_names_its_first_file_and_no_missing_ones() -> None:
    missing = []
    for package in sorted(PACKAGES):
        docstring, folder = ast.get_docstring(_tree(package)) or "", MODULES[package].parent
        begin = re.search(r"Begin\s+with\s+`([^`]+)`", docstring)
        assert begin, package
        assert (folder / begin[1]).exists(), package
        # Paths are relative to the folder, its parent or the repository.
        bases = (folder, folder.parent, ROOT)
        named = re.findall(r"`([\w/]+\.py)`", docstring)
        missing += [(package, name) for name in named if not any((base / name).exists() for base in bases)]
    assert missing == []


def test_tables_list_existing_modules_and_packages_with_torch() -> None:
    assert [name for name in LAYERS if name not in MODULES] == []
    lazy = [name for name in TORCH_PACKAGES if not any(_reaches_torch(m, set()) for m in MODULES if m.startswith(name))]
    assert lazy == [], "these packages do not load torch, so remove them from TORCH_PACKAGES"


def test_torch_is_imported_in_torch_packages_only() -> None:
    assert [name for name in MODULES if not _in_torch_package(name) and _reaches_torch(name, set())] == []


def test_client_imports_httpx_and_pydantic_only() -> None:
    # The server of the Model Context Protocol has an extra of its own.
    modules = [n for n in MODULES if n.split(".")[0] == "lalaloc_client" and n != "lalaloc_client.mcp_server"]
    loaded = {name for module in modules for name in _imported(module, _at_import_time(_tree(module)))}
    tops = {name.split(".")[0] for name in loaded} - sys.stdlib_module_names
    assert tops == {"httpx", "httpx_sse", "pydantic", "lalaloc_client"}


def test_importing_the_numpy_side_leaves_torch_unloaded() -> None:
    ours = [name for name in MODULES if name.split(".")[0] != "lalaloc_client"]
    names = [name for name in ours if not _in_torch_package(name) and not name.endswith("__main__")]
    if importlib.util.find_spec("ray") is None:
        names = [name for name in names if not name.startswith("service.on_ray")]
    program = (
        f"import importlib, sys\nfor name in {names!r}:\n    importlib.import_module(name)\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr or "torch was imported"


def test_service_starts_without_the_libraries_of_rare_requests() -> None:
    # Meshes, large venues, issuers of tokens, sequences, and refinement by latents.
    rare = ("trimesh", "networkx", "faiss", "httpx", "scipy.spatial", "scipy.special", "torch")
    program = f"import sys, service.app; print(*[name for name in {rare!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_no_name_is_undefined() -> None:
    # ruff's own check is off, because it takes the dimensions in array types for names.
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821", "--output-format", "json", "."]
    found = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout)
    undefined = []
    for path in {entry["filename"] for entry in found}:
        names = {
            (node.lineno, node.col_offset + 1): node.id
            for node in ast.walk(ast.parse(Path(path).read_text(encoding="utf-8")))
            if isinstance(node, ast.Name)
        }
        places = [
            (entry["location"]["row"], entry["location"]["column"]) for entry in found if entry["filename"] == path
        ]
        undefined += [f"{path}:{place[0]}: {names[place]}" for place in places if place in names]
    assert undefined == []
