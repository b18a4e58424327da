"""DWG drawings, converted to DXF by a program that is installed beside the package.

`dwg2dxf` of LibreDWG is preferred to the ODA File Converter, which runs with Qt on `offscreen`. The program runs
in a folder of its own, under the limits of time and unpacked bytes, and of memory where its parent has one.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions
from lalaloc_core.importers.formats import dxf

# Programs, in order of preference, with their arguments; {source} and {target} are folders.
_CONVERTERS = {
    "dwg2dxf": ("-y", "-o", "{target}/plan.dxf", "{source}/plan.dwg"),
    "ODAFileConverter": ("{source}", "{target}", "ACAD2018", "DXF", "0", "1", "*.dwg"),
}
_MAX_MESSAGE = 300


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan in the model space of a DWG drawing."""
    plans = dxf.read(_convert(content, budget), options, budget)
    return tuple(replace(plan, report=replace(plan.report, format="dwg")) for plan in plans)


def _convert(content: bytes, budget: Budget) -> bytes:
    program = next((found for name in _CONVERTERS if (found := shutil.which(name))), None)
    if program is None:
        raise InvalidFloorPlanError(
            "the file is a DWG drawing, and no program that reads it is installed; install dwg2dxf (LibreDWG) or "
            "ODAFileConverter (Open Design Alliance) beside the service, or save the drawing as DXF"
        )
    with tempfile.TemporaryDirectory(prefix="lalaloc-dwg-") as folder:
        source, target = Path(folder, "source"), Path(folder, "target")
        source.mkdir()
        target.mkdir()
        (source / "plan.dwg").write_bytes(content)
        places = {"source": str(source), "target": str(target)}
        name = Path(program).name
        message = _run([program, *(part.format(**places) for part in _CONVERTERS[name])], folder, budget)
        made = target / "plan.dxf"
        if not made.is_file() or made.is_symlink():
            raise InvalidFloorPlanError(
                f"{name} could not read the DWG drawing{message}; save the drawing as DXF, or in an older version"
            )
        size, limit = made.stat().st_size, budget.limits.max_unpacked_bytes
        if size >= limit:
            raise InvalidFloorPlanError(
                f"the DWG drawing converts to {size} bytes; the limit is {limit} (max_unpacked_bytes); export fewer "
                "layers"
            )
        budget.size_bytes = size
        return made.read_bytes()


def _run(command: list[str], folder: str, budget: Budget) -> str:
    """Run a converter until it ends, and return what it complained about."""
    limits, most_bytes = budget.limits, budget.limits.max_unpacked_bytes
    left_s = limits.max_import_s - budget.elapsed_s
    environment = {"PATH": os.environ.get("PATH", os.defpath), "HOME": folder, "QT_QPA_PLATFORM": "offscreen"}

    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most_bytes, most_bytes)),
        )
        try:
            process.wait(max(left_s, 0.1))
        except subprocess.TimeoutExpired as error:
            raise InvalidFloorPlanError(
                f"converting the DWG drawing takes more than {limits.max_import_s:g} s (max_import_s); save it as DXF"
            ) from error
        finally:
            # Its children belong to its group.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        lines = output.read(65_536).decode("utf-8", "replace").split()
    return f": {' '.join(lines)[:_MAX_MESSAGE]}" if lines else ""
