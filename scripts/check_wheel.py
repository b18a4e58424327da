"""Install a wheel of this package into an empty environment, and localise the example photograph with its service.

    python scripts/check_wheel.py dist/lalaloc-*.whl

Makes an environment of this interpreter, installs `lalaloc[service]` from the wheel, and runs `lalaloc-service serve
--example` in an empty folder. The exit status is 0 if the answer is right. Needs a package index.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_READY_TIMEOUT_S = 180.0
_SEARCHED = "kitchen"


def main() -> int:
    if sys.argv[1] == "--ask":
        return ask(sys.argv[2])
    (wheel,) = sys.argv[1:]
    with tempfile.TemporaryDirectory(prefix="lalaloc-wheel-") as folder:
        environment = Path(folder, "venv")
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        python = environment / "bin" / "python"
        requirement = f"lalaloc[service] @ {Path(wheel).resolve().as_uri()}"
        subprocess.run([python, "-m", "pip", "install", "-q", "--no-compile", requirement], check=True)
        return serve_and_ask(python, Path(folder))


def serve_and_ask(python: Path, folder: Path) -> int:
    """Start the installed service in a folder, ask it about the example photograph, and stop it."""
    # Neither this checkout nor its settings may help.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("LALALOC_", "PYTHON"))}
    command = [python.with_name("lalaloc-service"), "serve", "--example", "--port", "0"]
    service = subprocess.Popen(command, cwd=folder, env=kept, stdout=subprocess.PIPE, text=True)
    try:
        assert service.stdout is not None
        url = service.stdout.readline().strip()
        return subprocess.run([python, Path(__file__).resolve(), "--ask", url], cwd=folder, env=kept).returncode
    finally:
        service.terminate()
        service.wait(60.0)


def ask(url: str) -> int:
    """Localise an example photograph of the page at a service; 0 if it was taken in the room it shows."""
    import httpx

    with httpx.Client(base_url=url, timeout=60.0) as client:
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while client.get("/readyz").status_code != 200 or not _plans(client):
            if time.monotonic() > deadline:
                print(f"check_wheel: not ready: {client.get('/readyz').text}", file=sys.stderr)
                return 1
            time.sleep(0.2)
        photograph = client.get("/web/example-kitchen.jpg").raise_for_status().content
        fields = {"floorplan_id": _plans(client)[0]}
        answer = client.post("/localise", data=fields, files={"photo": photograph}).raise_for_status().json()
        page = client.get("/").raise_for_status()
    modules = sorted(path.name for path in Path(sys.prefix).glob("lib*/python*/site-packages/torch"))
    print(json.dumps({key: answer[key] for key in ("room", "position", "confidence", "stage")} | {"torch": modules}))
    is_right = answer["room"] == _SEARCHED and "text/html" in page.headers["content-type"]
    return 0 if is_right and not modules else 1


def _plans(client: object) -> list[str]:
    listed = client.get("/floorplans").raise_for_status().json()["floorplans"]  # type: ignore[attr-defined]
    return [plan["id"] for plan in listed if plan["status"] == "ready"]


if __name__ == "__main__":
    sys.exit(main())
