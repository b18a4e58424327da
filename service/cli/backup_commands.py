"""Commands that save and restore the stored data: `lalaloc-service backup` and `restore`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from service.settings import Settings
from service.storage.backup import back_up, database_file, restore


def add_backup_commands(commands: Any) -> None:
    """Add `backup` and `restore` to the commands."""
    saving = commands.add_parser("backup", help="copy an SQLite database to a new file, also while the service runs")
    saving.add_argument("file", type=Path, help="the new file")
    saving.set_defaults(run=_back_up)

    restoring = commands.add_parser(
        "restore", help="replace an SQLite database by a backup, also of an earlier version; stop the service first"
    )
    restoring.add_argument("file", type=Path, help="the backup")
    restoring.add_argument("--yes", action="store_true", required=True, help="confirm the replacement")
    restoring.set_defaults(run=_restore)


def _back_up(arguments: argparse.Namespace) -> int:
    database = database_file(Settings.load().database_url)
    size = back_up(database, arguments.file)
    print(f"copied '{database}' to '{arguments.file}' ({size} bytes)")
    return 0


def _restore(arguments: argparse.Namespace) -> int:
    database = database_file(Settings.load().database_url)
    earlier = restore(arguments.file, database)
    print(f"restored '{database}' from '{arguments.file}'")
    if earlier is not None:
        print(f"the database before is '{earlier}'; delete it when nothing is missing")
    return 0
