"""The model bundle: a folder with a manifest, ONNX files for the service and safetensors for LPO.

`manifest.json` names every file with its size and SHA-256; nothing is read that does not match. Reading a bundle
needs neither torch nor onnxruntime.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.files import atomic_write

MANIFEST_NAME = "manifest.json"
# The model card, which is no part of the model: it may be corrected without making it another one.
CARD_NAME = "README.md"
# Of the model that ships: in a checkout, and where a wheel puts it.
_CHECKOUT = Path("models/default")
_INSTALLED = Path("share/lalaloc/models/default")
FORMAT_VERSION = 2

LAYOUT_ONNX = "layout_encoder.onnx"
IMAGE_ONNX = "image_encoder.onnx"
HEAD_ONNX = "head.onnx"
LAYOUT_WEIGHTS = "layout_encoder.safetensors"
IMAGE_WEIGHTS = "image_encoder.safetensors"
DECODER_WEIGHTS = "decoder.safetensors"
# Made by calibration, not by export.
COHORT = "cohort.npz"
BUNDLE_FILES = (LAYOUT_ONNX, IMAGE_ONNX, HEAD_ONNX, LAYOUT_WEIGHTS, IMAGE_WEIGHTS, DECODER_WEIGHTS)


@dataclass(frozen=True, kw_only=True)
class LogisticModel:
    """Probability that a picture fits its plan by the signals of `localise.confidence`.

    What a model was not fitted with it leaves at 0: in models of earlier versions `answer_to_chance`, and
    `cost_to_chance` before there was a cohort; in those that are fitted now `cost_to_chance`, in whose place
    `answer_to_chance` came, and `log_odds`, which stood for the posterior before there was one.
    """

    bias: float
    log_odds: float
    cost: float
    uncertainty: float
    latent_distance: float
    cost_to_chance: float = 0.0
    answer_to_chance: float = 0.0

    def probability(
        self,
        *,
        log_odds: float,
        cost: float,
        uncertainty: float,
        latent_distance: float,
        cost_to_chance: float = 0.0,
        answer_to_chance: float = 0.0,
    ) -> float:
        """Confidence of an answer with these signals."""
        logit = self.bias + self.log_odds * log_odds + self.cost * cost
        logit += self.uncertainty * uncertainty + self.latent_distance * latent_distance
        logit += self.cost_to_chance * cost_to_chance + self.answer_to_chance * answer_to_chance
        return 1.0 / (1.0 + math.exp(-max(-30.0, min(30.0, logit))))


@dataclass(frozen=True, kw_only=True)
class MatchingWeights:
    """How much each term of the evidence may count, fitted on validation queries; see `localise.matching_cost`.

    Attributes:
        openings, ceiling, room_type: weights in units of the walls'.
        temperature: T, how many independent azimuths a cost is worth: likelihoods are `exp(-T cost)`.
    """

    openings: float = 0.7
    ceiling: float = 0.05
    room_type: float = 0.05
    temperature: float = 16.0


@dataclass(frozen=True, kw_only=True)
class ConfidenceModel:
    """How sure answers are, fitted on validation queries.

    Attributes:
        known_heading, searched_heading: by the stage that the answer came from ("retrieval", "vdr", "lpo").
        position_factor: covariance (m²) of the position, where the heading is known, in units of the inverse of the
            cost's curvature.
        position_factor_searched, heading_factor: of the position (m²) and the heading (radians²) where it is searched.
    """

    known_heading: dict[str, LogisticModel]
    searched_heading: dict[str, LogisticModel]
    position_factor: float | None = None
    position_factor_searched: float | None = None
    heading_factor: float | None = None

    def fit_probability(self, stage: str, signals: Mapping[str, float], *, heading_known: bool) -> float | None:
        """Probability that a picture is of the plan at all; None for a stage that no validation query came to."""
        model = (self.known_heading if heading_known else self.searched_heading).get(stage)
        return None if model is None else model.probability(**signals)


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """Size and digest of one file of the bundle."""

    bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a bundle is and how it came to be.

    Attributes:
        architecture: "ring", "trunk" or "paper".
        layout_config: arguments that rebuild the layout encoder in torch (for LPO).
        profile_columns: azimuth columns the layout encoder expects.
        image_height, image_width: pixels the image encoder expects; pixel values are raw uint8 RGB and the
            normalisation stated in `image_mean` and `image_std` happens inside the network.
        ring_sectors: azimuth sectors of the ring, 0 for an architecture without one.
        image_config: arguments that rebuild the image encoder in torch, where they are not those of the layout encoder.
        opening_classes: what the image encoder tells apart at each azimuth; none where it tells nothing of the kind.
        opening_prior: the classes' shares that its probabilities presume; dividing by them leaves likelihoods.
        room_types: types of rooms that it tells apart, and `room_type_prior` their shares in what it was trained on.
        confidence: fitted on validation queries; None leaves answers without a trained confidence.
        evidence: weights of what poses are compared by.
        training: commands, seeds, hardware, counts of how the model was trained.
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
    confidence: ConfidenceModel | None = None
    evidence: MatchingWeights = field(default_factory=MatchingWeights)
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    files: dict[str, FileEntry] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION

    def to_json(self) -> str:
        """The manifest as indented JSON text."""
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
            raise BundleError(f"manifest format {raw.get('format_version')!r}, this code reads {FORMAT_VERSION}")
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
        """Read the manifest of a bundle; files are checked when they are read.

        Raises:
            BundleError: no manifest there, or not a valid one.
        """
        path = folder / MANIFEST_NAME
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise BundleError(f"no model bundle at '{folder}': {error.strerror} ({MANIFEST_NAME})") from error
        manifest = Manifest.from_json(text)
        return cls(folder, manifest, _digest_of(manifest))

    def check(self) -> None:
        """Read every file, and believe none.

        Raises:
            BundleError: one is missing, or altered.
        """
        for name in self.manifest.files:
            self.read(name)

    def read(self, name: str) -> bytes:
        """The bytes of one file, checked against the manifest.

        Raises:
            BundleError: the file is not listed, missing, or altered.
        """
        entry = self.manifest.files.get(name)
        if entry is None:
            raise BundleError(f"bundle '{self.folder}' lists no file '{name}'")
        try:
            content = (self.folder / name).read_bytes()
        except OSError as error:
            raise BundleError(f"bundle '{self.folder}': cannot read '{name}': {error.strerror}") from error
        digest = hashlib.sha256(content).hexdigest()
        if digest != entry.sha256:
            raise BundleError(f"bundle '{self.folder}': '{name}' has SHA-256 {digest}, expected {entry.sha256}")
        return content


def default_bundle() -> Path:
    """The folder of the model that ships: that of the checkout which this file is in, else the installed one.

    Where the working folder is the checkout, the path is relative, so that what runs write down holds elsewhere.
    """
    checkout = Path(__file__).resolve().parents[2] / _CHECKOUT
    if (checkout / MANIFEST_NAME).is_file():
        return _CHECKOUT if _CHECKOUT.resolve() == checkout else checkout
    with suppress(PackageNotFoundError):
        for file in distribution("lalaloc").files or []:
            path = Path(file.locate()).resolve()
            if path.name == MANIFEST_NAME and path.parent.match(f"*/{_INSTALLED}"):
                return path.parent
    # Nothing is there; whoever opens it is told so.
    return checkout


def write_manifest(folder: Path, manifest: Manifest) -> Bundle:
    """Write the manifest over the files that lie in `folder`, but for its card, recording sizes and digests."""
    files = {}
    for path in sorted(folder.iterdir()):
        if path.name not in (MANIFEST_NAME, CARD_NAME):
            content = path.read_bytes()
            files[path.name] = FileEntry(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
    complete = dataclasses.replace(manifest, files=files)
    atomic_write(folder / MANIFEST_NAME, complete.to_json())
    return Bundle(folder, complete, _digest_of(complete))


def _digest_of(manifest: Manifest) -> str:
    """Identity of the model: a digest over its files, so that re-scoring or renaming does not change it."""
    listing = "\n".join(f"{name} {entry.sha256}" for name, entry in sorted(manifest.files.items()))
    return hashlib.sha256(listing.encode()).hexdigest()
