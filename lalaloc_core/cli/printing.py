"""What commands print."""

from __future__ import annotations

import json
from typing import Any


def print_json(value: Any) -> None:
    """Indented JSON on standard output."""
    print(json.dumps(value, indent=2))
