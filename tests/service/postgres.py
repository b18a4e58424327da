"""PostgreSQL server for the tests: a temporary cluster on a free port."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy

from tests.local_servers import free_port

_DEBIAN = Path("/usr/lib/postgresql")
_START_S = 60


@dataclass(frozen=True)
class PostgresServer:
    """Running cluster.

    Attributes:
        programs: folder of PostgreSQL's programs.
        folder: data folder.
        port: port on the loopback interface.
    """

    programs: Path
    folder: Path
    port: int

    def url(self, user: str = "postgres") -> str:
        """Return the URL of the database, as an operator writes it."""
        return f"postgresql://{user}@127.0.0.1:{self.port}/postgres"

    def new_database(self) -> str:
        """Create a user with an own empty schema, and return the URL.

        The schema isolates a test like a database of its own, and is created and removed in a hundredth of the time.
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
        """Lock a table inside the block, so that readers and writers wait."""
        engine = sqlalchemy.create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
        with engine.connect() as connection:
            connection.exec_driver_sql(f"LOCK TABLE {table}")
            yield
        engine.dispose()

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Stop all processes of the server inside the block: it neither answers nor closes connections."""
        postmaster = int((self.folder / "postmaster.pid").read_text(encoding="ascii").split()[0])
        # The postmaster first, so that no new processes start.
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
        log = self.folder / "log"
        # Tests do not crash the machine, so fsync is not needed.
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
        command = [self.programs / "pg_ctl", "start", "-w", "-t", str(_START_S)]
        _run([*command, "-D", self.folder, "-l", log, "-o", options])

    def stop(self) -> None:
        """Stop the server, and disconnect its clients."""
        _run([self.programs / "pg_ctl", "stop", "-w", "-m", "fast", "-D", self.folder, "-t", str(_START_S)])


def postgres_programs() -> Path | None:
    """Return the folder of `initdb` of the newest installed PostgreSQL; None without one."""
    found = shutil.which("initdb")
    if found is not None:
        return Path(found).resolve().parent
    versions = [folder for folder in _DEBIAN.glob("*/bin") if (folder / "initdb").exists()]
    return max(versions, key=lambda folder: float(folder.parent.name), default=None)


@contextmanager
def postgres_server(programs: Path) -> Iterator[PostgresServer]:
    with tempfile.TemporaryDirectory(prefix="lalaloc-postgres-") as parent:
        folder = Path(parent) / "cluster"
        if (user := _user()) is not None:
            shutil.chown(parent, user)
        _run([programs / "initdb", "-D", folder, "-U", "postgres", "-A", "trust", "-E", "UTF8", "--no-sync"])
        server = PostgresServer(programs, folder, free_port())
        server.start()
        try:
            yield server
        finally:
            stop = [server.programs / "pg_ctl", "stop", "-m", "immediate", "-D", folder]
            subprocess.run(stop, user=_user(), cwd="/", capture_output=True, check=False)


def _run(command: list[str | Path]) -> None:
    # Output goes to a file, because the server would keep a pipe open.
    with tempfile.TemporaryFile() as output:
        done = subprocess.run(command, user=_user(), cwd="/", stdout=output, stderr=output, check=False)
        output.seek(0)
        assert done.returncode == 0, f"{command[0]} failed: {output.read().decode(errors='replace')}"


def _children(pid: int) -> list[int]:
    listing = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(line) for line in listing.stdout.split()]


def _user() -> str | None:
    """Return the user for the server, which refuses to run as root; Debian's package creates one."""
    if os.geteuid() != 0:
        return None
    pwd.getpwnam("postgres")
    return "postgres"
