"""The model bundle on disk: a folder with a manifest, ONNX files for the service and safetensors for LPO.

`manifest.json` names every file with its size and SHA-256; nothing is read that does not match. Reading a bundle
needs neither torch nor onnxruntime.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

from lalaloc_core.bundle.manifest import CARD_NAME, FileEntry, Manifest
from lalaloc_core.errors import BundleError
from lalaloc_core.files import MANIFEST_NAME, atomic_write


@dataclass(frozen=True)
class Bundle:
    """A model bundle on disk, its manifest parsed."""

    folder: Path
    manifest: Manifest
    sha256: str

    @classmethod
    def open(cls, folder: Path) -> Bundle:
        """Read the manifest of a bundle; files are checked when they are read."""
        path = folder / MANIFEST_NAME
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise BundleError(f"no model bundle at '{folder}': {error.strerror} ({MANIFEST_NAME})") from error
        except UnicodeDecodeError as error:
            raise BundleError(
                f"byte {error.start} of '{path}' is not UTF-8; download or export the bundle again"
            ) from error
        manifest = Manifest.from_json(text)
        return cls(folder, manifest, manifest.sha256)

    def check(self) -> None:
        """Check size and digest of every file."""
        for name in self.manifest.files:
            self.read(name)

    def read(self, name: str) -> bytes:
        """Read one file and check it against the manifest.

        Raises:
            BundleError: the file is not listed, missing, or altered.
        """
        entry = self.manifest.files.get(name)
        if entry is None:
            raise BundleError(f"bundle '{self.folder}' has no file '{name}' in its manifest")
        try:
            content = (self.folder / name).read_bytes()
        except OSError as error:
            raise BundleError(f"bundle '{self.folder}': cannot read '{name}': {error.strerror}") from error
        digest = hashlib.sha256(content).hexdigest()
        if digest != entry.sha256:
            raise BundleError(
                f"bundle '{self.folder}': '{name}' has the SHA-256 {digest}; the manifest states {entry.sha256}"
            )
        return content


def write_manifest(folder: Path, manifest: Manifest) -> Bundle:
    """Write the manifest of the files in `folder`, except the model card, with their sizes and digests."""
    files = {}
    for path in sorted(folder.iterdir()):
        if path.name not in (MANIFEST_NAME, CARD_NAME):
            content = path.read_bytes()
            files[path.name] = FileEntry(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
    complete = dataclasses.replace(manifest, files=files)
    atomic_write(folder / MANIFEST_NAME, complete.to_json())
    return Bundle(folder, complete, complete.sha256)
