"""A PostgreSQL server of the tests' own: a fresh cluster on a free port, stopped and removed at the end."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy

_DEBIAN = Path("/usr/lib/postgresql")
_START_S = 60


@dataclass(frozen=True)
class PostgresServer:
    """A running cluster.

    Attributes:
        folder: its data folder.
    """

    programs: Path
    folder: Path
    port: int

    def url(self, user: str = "postgres") -> str:
        """The address of its database, as an operator would write it."""
        return f"postgresql://{user}@127.0.0.1:{self.port}/postgres"

    def new_database(self) -> str:
        """Make a user with an empty schema of their own, which is all they see; gives the address.

        As good as a database of their own, and made and removed in a hundredth of the time.
        """
        name = f"test_{uuid.uuid4().hex}"
        engine = sqlalchemy.create_engine(
            self.url().replace("postgresql:", "postgresql+psycopg:"), isolation_level="AUTOCOMMIT"
        )
        with engine.connect() as connection:
            connection.exec_driver_sql(f"CREATE ROLE {name} LOGIN")
            connection.exec_driver_sql(f"CREATE SCHEMA {name} AUTHORIZATION {name}")
        engine.dispose()
        return self.url(name)

    @contextmanager
    def locked(self, url: str, table: str) -> Iterator[None]:
        """Inside the block, whoever reads or writes a table of a database of `new_database` waits."""
        engine = sqlalchemy.create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
        with engine.connect() as connection:
            connection.exec_driver_sql(f"LOCK TABLE {table}")
            yield
        engine.dispose()

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Inside the block it does not answer, nor does it close a connection: all its processes stand still."""
        postmaster = int((self.folder / "postmaster.pid").read_text(encoding="ascii").split()[0])
        # It first, so that no more of them come.
        stopped = [postmaster]
        os.kill(postmaster, signal.SIGSTOP)
        try:
            for pid in _children(postmaster):
                os.kill(pid, signal.SIGSTOP)
                stopped.append(pid)
            yield
        finally:
            for pid in reversed(stopped):
                os.kill(pid, signal.SIGCONT)

    def start(self) -> None:
        """Start it, or start it again."""
        log = self.folder / "log"
        # Tests end their processes, not the machine: what is not on the disk yet need not wait for it.
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
        command = [self.programs / "pg_ctl", "start", "-w", "-t", str(_START_S)]
        _run([*command, "-D", self.folder, "-l", log, "-o", options])

    def stop(self) -> None:
        """Stop it at once, whoever is connected."""
        _run([self.programs / "pg_ctl", "stop", "-w", "-m", "fast", "-D", self.folder, "-t", str(_START_S)])


def postgres_programs() -> Path | None:
    """The folder of `initdb` and the others, of the newest PostgreSQL here; None where it is not installed."""
    found = shutil.which("initdb")
    if found is not None:
        return Path(found).resolve().parent
    versions = [folder for folder in _DEBIAN.glob("*/bin") if (folder / "initdb").exists()]
    return max(versions, key=lambda folder: float(folder.parent.name), default=None)


@contextmanager
def postgres_server(programs: Path) -> Iterator[PostgresServer]:
    """Run a cluster of its own."""
    with tempfile.TemporaryDirectory(prefix="lalaloc-postgres-") as parent:
        folder = Path(parent) / "cluster"
        if (user := _user()) is not None:
            shutil.chown(parent, user)
        _run([programs / "initdb", "-D", folder, "-U", "postgres", "-A", "trust", "-E", "UTF8", "--no-sync"])
        server = PostgresServer(programs, folder, _free_port())
        server.start()
        try:
            yield server
        finally:
            subprocess.run(
                [server.programs / "pg_ctl", "stop", "-m", "immediate", "-D", folder],
                user=_user(),
                cwd="/",
                capture_output=True,
                check=False,
            )


def _run(command: list[str | Path]) -> None:
    # Output goes to a file: the server would keep a pipe open for as long as it runs.
    with tempfile.TemporaryFile() as output:
        done = subprocess.run(command, user=_user(), cwd="/", stdout=output, stderr=output, check=False)
        output.seek(0)
        assert done.returncode == 0, f"{command[0]} failed: {output.read().decode(errors='replace')}"


def _children(pid: int) -> list[int]:
    listing = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(line) for line in listing.stdout.split()]


def _user() -> str | None:
    """PostgreSQL refuses to run as root; Debian's package comes with a user for it."""
    if os.geteuid() != 0:
        return None
    pwd.getpwnam("postgres")
    return "postgres"


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
