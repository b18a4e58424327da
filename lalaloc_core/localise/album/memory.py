"""Memory of an album: what is slow to find and does not depend on corrections."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lalaloc_core.bundle import Manifest
from lalaloc_core.errors import InvalidEntryError
from lalaloc_core.localise.album.ground import AlbumGround

# Arrays of one photograph by name.
Arrays = dict[str, np.ndarray]
_MAX_BYTES = 2**28
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, OSError, EOFError, RecursionError, zipfile.BadZipFile)


@dataclass(eq=False)
class AlbumMemory:
    """Evidence of single photographs and links between them, for one ground and model.

    Pass the same object to every `solve_album` of an album; it is filled there. Not safe to share between threads.

    Attributes:
        key: digest of ground and model; empty for a new memory.
        evidence: arrays of each photograph, by id.
        links: matches and turn by pair of ids; None for pairs that do not overlap.
    """

    key: str = ""
    evidence: dict[str, Arrays] = field(default_factory=dict)
    links: dict[tuple[str, str], tuple[int, float] | None] = field(default_factory=dict)

    def use(self, ground: AlbumGround, manifest: Manifest) -> None:
        """Drop everything that is of another ground or model."""
        key = hashlib.sha256(f"{ground.digest} {sorted(manifest.files.items())}".encode()).hexdigest()
        if key != self.key:
            # Links depend on the photographs alone.
            self.key, self.evidence = key, {}

    def keep(self, ids: set[str]) -> None:
        """Drop what is about photographs that are no longer in the album."""
        self.evidence = {id: arrays for id, arrays in self.evidence.items() if id in ids}
        self.links = {pair: link for pair, link in self.links.items() if ids.issuperset(pair)}

    def to_bytes(self) -> bytes:
        """Return the memory as a file: an archive of arrays, as numpy writes them."""
        ids = sorted(self.evidence)
        links = [[*pair, *(link or (0, 0.0))] for pair, link in sorted(self.links.items())]
        head = {"key": self.key, "ids": ids, "links": links}
        arrays: dict[str, Any] = {
            f"{number}.{name}": values for number, id in enumerate(ids) for name, values in self.evidence[id].items()
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, head=np.frombuffer(json.dumps(head).encode(), np.uint8), **arrays)
        return buffer.getvalue()

    @classmethod
    def read(cls, content: bytes) -> AlbumMemory:
        """Read a memory that this service stored itself.

        Raises:
            InvalidEntryError: the file is damaged; go on with a new memory.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                if sum(entry.file_size for entry in archive.zip.infolist()) > _MAX_BYTES:
                    raise InvalidEntryError(f"the memory of the album would be larger than {_MAX_BYTES} bytes")
                head = json.loads(archive["head"].tobytes())
                evidence: dict[str, Arrays] = {id: {} for id in head["ids"]}
                for name in archive.files:
                    number, _, kind = name.partition(".")
                    if kind:
                        evidence[head["ids"][int(number)]][kind] = archive[name]
                links = {
                    (str(first), str(second)): (int(matches), float(turn)) if matches else None
                    for first, second, matches, turn in head["links"]
                }
                return cls(str(head["key"]), evidence, links)
        except _DAMAGE as error:
            raise InvalidEntryError(f"the memory of the album is damaged: {error}") from error
