"""Content of requests, and the generated files of the package."""

from __future__ import annotations

from lalaloc_client import AsyncClient, Client
from scripts.generate_client import generated_files


def test_blocking_client_is_up_to_date() -> None:
    stale = [path.name for path, text in generated_files().items() if path.read_text(encoding="utf-8") != text]
    assert stale == [], "run `make client`"


def test_clients_have_the_same_methods() -> None:
    assert [name for name in vars(Client) if name[0] != "_"] == [name for name in vars(AsyncClient) if name[0] != "_"]
