"""The model bundle on disk: a folder with a manifest, ONNX files for the service and safetensors for LPO.

`manifest.json` names every file with its size and SHA-256; nothing is read that does not match. Reading a bundle
needs neither torch nor onnxruntime.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lalaloc_core.bundle.fitted_parameters import AlbumWeights, ConfidenceModel, MatchingWeights, PredictionErrors
from lalaloc_core.configuration import build_config
from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.files import MANIFEST_NAME, atomic_write

# The model card, which can be corrected without changing the model's digest.
CARD_NAME = "README.md"
FORMAT_VERSION = 2

LAYOUT_ONNX = "layout_encoder.onnx"
IMAGE_ONNX = "image_encoder.onnx"
HEAD_ONNX = "head.onnx"
LAYOUT_WEIGHTS = "layout_encoder.safetensors"
IMAGE_WEIGHTS = "image_encoder.safetensors"
DECODER_WEIGHTS = "decoder.safetensors"
# Encoder of views, photographs that show a part of the horizon; not every bundle has one.
VIEW_ONNX = "view_encoder.onnx"
VIEW_WEIGHTS = "view_encoder.safetensors"
# Classifier and detector of objects in photographs; not every bundle has them.
OBJECTS_ONNX, DETECTOR_ONNX = "objects.onnx", "detector.onnx"
# Made by calibration, not by export.
COHORT = "cohort.npz"
BUNDLE_FILES = (
    LAYOUT_ONNX, IMAGE_ONNX, HEAD_ONNX, LAYOUT_WEIGHTS, IMAGE_WEIGHTS, DECODER_WEIGHTS, VIEW_ONNX, VIEW_WEIGHTS,
    OBJECTS_ONNX, DETECTOR_ONNX,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """Size and SHA-256 of one file of the bundle."""

    bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class ViewManifest:
    """Encoder of views.

    Attributes:
        config: arguments that rebuild it in torch.
        image_height, image_width: pixels of a patch.
        sectors: sectors of the ring that a patch covers.
        top_deg: elevation of a patch's upper border.
        opening_prior, room_type_prior, evidence, confidence, errors: as those of the manifest, for views; without
            fitted weights or confidence, those of spheres apply.
        turn_confidence: as `confidence`, for several photographs from one spot; None, as in bundles of earlier
            versions, applies that of single ones.
    """

    config: dict[str, Any]
    image_height: int
    image_width: int
    sectors: int
    top_deg: float
    opening_prior: list[float]
    room_type_prior: list[float]
    evidence: MatchingWeights | None = None
    confidence: ConfidenceModel | None = None
    errors: PredictionErrors | None = None
    turn_confidence: ConfidenceModel | None = None


@dataclass(frozen=True, kw_only=True)
class ObjectsManifest:
    """Classifier and detector of objects, which tell types of rooms.

    Attributes:
        names: names of the objects, in the order of the networks' outputs.
        shares: (objects, room types) share of each object that a room of each type accounts for.
        floor: probability that every object has in photographs without it.
        detected: number of the last names, which the detector finds; 0 for bundles without one.
        detected_floor, detected_weight: score that it gives to what is not there, and share of the rest that counts.
    """

    names: list[str]
    shares: list[list[float]]
    floor: float = 0.01
    detected: int = 0
    detected_floor: float = 0.3
    detected_weight: float = 0.7

    def __post_init__(self) -> None:
        if len(self.shares) != len(self.names) or any(len(row) != len(ROOM_TYPES) for row in self.shares):
            raise ConfigError(
                f"objects.shares must have a row for each of {len(self.names)} names and {len(ROOM_TYPES)} columns"
            )


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Manifest of a bundle: architecture, inputs and outputs, calibration, and provenance.

    Attributes:
        architecture: "ring", "trunk" or "paper".
        layout_config: arguments that rebuild the layout encoder in torch (for LPO).
        profile_columns: azimuth columns the layout encoder expects.
        image_height, image_width: pixels the image encoder expects; pixel values are raw uint8 RGB and the
            normalisation stated in `image_mean` and `image_std` happens inside the network.
        ring_sectors: azimuth sectors of the ring, 0 for an architecture without one.
        image_config: arguments that rebuild the image encoder in torch, if they differ from the layout encoder's.
        opening_classes: opening classes that the image encoder predicts; empty if it predicts none.
        opening_prior: frequencies of the classes that its probabilities presume.
        room_types: room types that it predicts; `room_type_prior` are their frequencies in the training data.
        view: encoder of views; None if the bundle has none.
        objects: classifier and detector of objects; None if the bundle has none.
        confidence: models of the confidence; None leaves answers without one.
        evidence: weights of the matching cost.
        album: weights of what counts in albums only.
        errors: measured errors of the predictions; None if they were not measured.
        training: commands, seeds, hardware and counts of the training.
        metrics: validation figures with their n.
    """

    name: str
    version: str
    architecture: str
    layout_config: dict[str, Any]
    profile_columns: int
    image_height: int
    image_width: int
    image_mean: list[float]
    image_std: list[float]
    latent_size: int
    ring_sectors: int
    image_config: dict[str, Any] = field(default_factory=dict)
    opening_classes: list[str] = field(default_factory=list)
    opening_prior: list[float] = field(default_factory=list)
    room_types: list[str] = field(default_factory=list)
    room_type_prior: list[float] = field(default_factory=list)
    view: ViewManifest | None = None
    objects: ObjectsManifest | None = None
    confidence: ConfidenceModel | None = None
    evidence: MatchingWeights = field(default_factory=MatchingWeights)
    album: AlbumWeights = field(default_factory=AlbumWeights)
    errors: PredictionErrors | None = None
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    files: dict[str, FileEntry] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION

    def evidence_for(self, *, view: bool) -> MatchingWeights:
        """Return the weights of the matching cost for spheres or for views."""
        own = None if self.view is None or not view else self.view.evidence
        return self.evidence if own is None else own

    def confidence_for(self, *, view: bool, turn: bool = False) -> ConfidenceModel | None:
        """Return the models of the confidence for spheres, for views, or for turns of several views."""
        own = [self.view.turn_confidence if turn else None, self.view.confidence] if self.view and view else []
        return next((model for model in own if model is not None), self.confidence)

    @property
    def sha256(self) -> str:
        """Identity of the model: a digest over its files, which new metrics or names do not change."""
        listing = "\n".join(f"{name} {entry.sha256}" for name, entry in sorted(self.files.items()))
        return hashlib.sha256(listing.encode()).hexdigest()

    def to_json(self) -> str:
        """Return the manifest as indented JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2, sort_keys=True) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Manifest:
        """Parse strictly: unknown or missing keys and values of a wrong type are errors.

        Raises:
            BundleError: not a manifest of this format version.
        """
        try:
            raw = json.loads(text)
        except ValueError as error:
            raise BundleError(f"{MANIFEST_NAME} is not JSON: {error}") from error
        if not isinstance(raw, dict):
            raise BundleError(f"{MANIFEST_NAME} must be a JSON object, not {type(raw).__name__}")
        if raw.get("format_version") != FORMAT_VERSION:
            raise BundleError(
                f"the manifest's format_version is {raw.get('format_version')!r}; this version reads {FORMAT_VERSION}"
            )
        try:
            return build_config(cls, raw, path="manifest")
        except ConfigError as error:
            raise BundleError(f"not a valid {MANIFEST_NAME}: {error}") from error


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
