"""Write the API description: `python -m service.openapi [FILE]` (default: standard output)."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import yaml

from service.app import create_app


def openapi_text() -> str:
    """Return the API description as YAML; deterministic."""
    header = "# Written by `python -m service.openapi openapi.yaml`; do not edit.\n"
    # Through JSON, so that YAML has no anchors for shared parts.
    document = json.loads(json.dumps(create_app().openapi()))
    return header + yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", nargs="?", type=Path, help="file to write (default: standard output)")
    file = parser.parse_args().file
    if file is None:
        sys.stdout.write(openapi_text())
    else:
        file.write_text(openapi_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
