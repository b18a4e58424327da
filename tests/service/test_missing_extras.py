"""Formats whose packages are not installed: the error names the extra to install."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import export_plan
from tests.importers.conftest import FLAT as PLAN
from tests.importers.test_pictures import vector_pdf
from tests.service.conftest import StartApp, assert_problem, upload

# Created before the packages are hidden.
_PLAN = FloorPlan.from_dict(dict(PLAN))
FILES = {
    "ifc": (b"ISO-10303-21;\nHEADER;\nFILE_SCHEMA(('IFC4'));\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n", "ifc"),
    "pdf": (vector_pdf(), "plans"),
    "dxf": (export_plan(_PLAN, "dxf"), "plans"),
    "svg": (export_plan(_PLAN, "svg"), "plans"),
}
PACKAGES = ("ifcopenshell", "pypdfium2", "ezdxf", "svgelements")


@pytest.fixture(scope="module")
def bare(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Start the app with workers that find none of the packages."""
    shadows = tmp_path_factory.mktemp("shadows")
    for name in PACKAGES:
        raising = f"raise ModuleNotFoundError(\"No module named '{name}'\", name={name!r})\n"
        (shadows / f"{name}.py").write_text(raising)
    with pytest.MonkeyPatch.context() as patch:
        # Workers inherit the search path of their parent.
        patch.syspath_prepend(str(shadows))
        with start_app(tmp_path_factory.mktemp("data")) as client:
            yield client


@pytest.mark.parametrize(("content", "extra"), FILES.values(), ids=FILES.keys())
def test_import_without_package_names_the_extra(bare: httpx.Client, content: bytes, extra: str) -> None:
    fields = {"metres_per_pixel": "0.01"}
    response = bare.post("/floorplans", files={"file": ("plan", content)}, data=fields)
    problem = assert_problem(response, 501, "missing-extra")
    assert f"the extra `{extra}`" in problem["detail"]
    assert f".venv/bin/pip install -c constraints.txt -e '.[{extra}]'" in problem["detail"]


def test_export_without_package_names_the_extra(bare: httpx.Client) -> None:
    # Large enough to be exported by a worker; the packages are hidden from workers only.
    rooms = [{"polygon": [[x, 0], [x + 4, 0], [x + 4, 3], [x, 3]]} for x in range(0, 1000, 5)]
    plan_id = upload(bare, {"ceiling_height_m": 2.5, "rooms": rooms})
    problem = assert_problem(bare.get(f"/floorplans/{plan_id}/export?format=dxf"), 501, "missing-extra")
    assert "the extra `plans`" in problem["detail"]
    assert bare.get(f"/floorplans/{plan_id}/export?format=native").status_code == 200
