"""Generated files of the client are up to date, and the API's description and the README make clients that work."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import yaml

from lalaloc_client import AsyncClient, Client
from scripts.generate_client import generated_files
from tests.service.conftest import StartApp

ROOT = Path(__file__).parents[2]
ADDRESS = "http://127.0.0.1:8000"
DESCRIPTION: dict[str, Any] = yaml.load((ROOT / "openapi.yaml").read_bytes(), yaml.CSafeLoader)
# Programs that were generated before call their methods by these names, so none may change or go.
NAMES = """
    createFloorplan listFloorplans getFloorplan replaceFloorplan deleteFloorplan getOriginal getExport getPreview
    getMesh getLayout followFloorplan createVenue listVenues getVenue replaceVenue changeVenue deleteVenue
    listVenuePlans localise localiseBatch localiseSequence createSession getSession deleteSession addPhotograph
    getAnswer deleteAnswer getHealth getReadiness getMetrics getLimits getUsage
"""
OPERATIONS = [operation for operations in DESCRIPTION["paths"].values() for operation in operations.values()]


def test_operations_keep_their_names() -> None:
    names = [operation.get("operationId", "") for operation in OPERATIONS]
    assert set(NAMES.split()) <= set(names)
    assert len(names) == len(set(names))
    assert [name for name in names if not re.fullmatch(r"[a-z]+([A-Z][a-z]+)*", name)] == []


def test_schemas_begin_with_required_properties() -> None:
    for name, schema in DESCRIPTION["components"]["schemas"].items():
        required = [field in schema.get("required", []) for field in schema.get("properties", {})]
        assert required == sorted(required, reverse=True), name


def test_json_answers_are_not_described_as_strings_too() -> None:
    contents = [response.get("content", {}) for each in OPERATIONS for response in each["responses"].values()]
    described = [content for content in contents if "$ref" in content.get("application/json", {}).get("schema", {})]
    assert len(described) > 10
    strings = [
        media for content in described for media, body in content.items() if body["schema"].get("type") == "string"
    ]
    assert strings == []


@pytest.mark.slow
def test_generated_python_client_localises(
    start_app: StartApp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "generated_lalaloc"
    arguments = ["generate", "--path", "openapi.yaml", "--meta", "none", "--output-path", str(package)]
    command = [sys.executable, "-m", "openapi_python_client", *arguments]
    subprocess.run(command, cwd=ROOT, check=True, timeout=300, stdout=subprocess.DEVNULL)
    monkeypatch.syspath_prepend(tmp_path)

    def generated(name: str) -> Any:
        return importlib.import_module(f"generated_lalaloc.{name}")

    for module in package.rglob("*.py"):
        generated(".".join(module.relative_to(package).with_suffix("").parts))
    models, types = generated("models"), generated("types")
    upload, localise = generated("api.floor_plans.create_floorplan"), generated("api.localisation.localise")
    flat = models.FloorPlanDocument.from_dict(json.loads((ROOT / "examples" / "flat.json").read_text(encoding="utf-8")))
    picture = BytesIO((ROOT / "examples" / "kitchen.jpg").read_bytes())
    photo = types.File(payload=picture, file_name="kitchen.jpg", mime_type="image/jpeg")
    with start_app(tmp_path / "data") as app:
        client = generated("client").Client(str(app.base_url).rstrip("/"), timeout=None)
        plan = upload.sync(client=client, body=flat)
        assert isinstance(plan, models.FloorPlanAnswer), plan
        answer = localise.sync(client=client, body=models.LocaliseLocaliseForm(photo=photo, floorplan_id=plan.id))
    assert isinstance(answer, models.LocaliseAnswer), answer
    assert answer.floorplan_id == plan.id
    assert answer.room in {room.name for room in flat.rooms}


def test_readme_requests_work_as_written(start_app: StartApp, tmp_path: Path) -> None:
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    requests = [block for block in blocks if f"{ADDRESS}/localise" in block]
    assert len(requests) == 1
    with start_app(tmp_path) as app:
        script = requests[0].replace(ADDRESS, str(app.base_url).rstrip("/"))
        done = subprocess.run(["sh", "-euc", script], cwd=ROOT, stdout=subprocess.PIPE, timeout=300, check=True)
    assert json.loads(done.stdout)["heading_deg"] == 250.0


def test_blocking_client_is_up_to_date() -> None:
    stale = [path.name for path, text in generated_files().items() if path.read_text(encoding="utf-8") != text]
    assert stale == [], "run `make client`"


def test_clients_have_the_same_methods() -> None:
    assert [name for name in vars(Client) if name[0] != "_"] == [name for name in vars(AsyncClient) if name[0] != "_"]
