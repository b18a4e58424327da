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
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.files import atomic_write
from lalaloc_core.localise.prediction_errors import PredictionErrors

MANIFEST_NAME = "manifest.json"
# The model card, which can be corrected without changing the model's digest.
CARD_NAME = "README.md"
# Folder of the model that ships: in a checkout, and in an installation.
_CHECKOUT = Path("models/default")
_INSTALLED = Path("share/lalaloc/models/default")
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
# Made by calibration, not by export.
COHORT = "cohort.npz"
BUNDLE_FILES = (
    LAYOUT_ONNX,
    IMAGE_ONNX,
    HEAD_ONNX,
    LAYOUT_WEIGHTS,
    IMAGE_WEIGHTS,
    DECODER_WEIGHTS,
    VIEW_ONNX,
    VIEW_WEIGHTS,
)


@dataclass(frozen=True, kw_only=True)
class LogisticModel:
    """Probability that a picture fits its plan, a logistic function of the signals of `localise.confidence`.

    The class is here because its weights are part of the manifest; `confidence.confidence_of` is the only function that
    computes the confidence of an answer from it.

    Weights of signals that a model was not fitted with are 0: `answer_to_chance` and, without a cohort,
    `cost_to_chance` in models of earlier versions; `cost_to_chance` and `log_odds` in models that are fitted now.
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
        """Return the probability for some signals."""
        logit = self.bias + self.log_odds * log_odds + self.cost * cost
        logit += self.uncertainty * uncertainty + self.latent_distance * latent_distance
        logit += self.cost_to_chance * cost_to_chance + self.answer_to_chance * answer_to_chance
        return 1.0 / (1.0 + math.exp(-max(-30.0, min(30.0, logit))))


@dataclass(frozen=True, kw_only=True)
class MatchingWeights:
    """Weights of the terms of the matching cost, fitted on validation queries; see `localise.matching_cost`.

    Attributes:
        openings, ceiling, room_type: weights in units of the walls'.
        tail: κ, the scale of errors of walls and ceilings over the predicted one.
        temperature: T, the number of independent azimuths: likelihoods are `exp(-T cost)`.
        appearance: for every opening class of a plan (rows, in the order of `conventions.OPENING_CLASSES`) the
            probabilities of what it looks like (columns); None if every class looks like itself.
        usual_cost: cost of the best place at a right heading, below which a given heading is not doubted.
        usual_gain: share of that cost by which a search over all headings lowers it beside a right heading; only a
            larger gain overrules a given heading.
    """

    openings: float = 0.7
    ceiling: float = 0.05
    room_type: float = 0.05
    tail: float = 3.0
    temperature: float = 16.0
    appearance: tuple[tuple[float, ...], ...] | None = None
    usual_cost: float = 0.0
    usual_gain: float = 0.0

    def __post_init__(self) -> None:
        """Check the shape and the sums of `appearance`."""
        if self.appearance is None:
            return
        classes = len(OPENING_CLASSES)
        is_square = len(self.appearance) == classes and all(len(row) == classes for row in self.appearance)
        if not is_square or any(min(row) < 0.0 or abs(sum(row) - 1.0) > 1e-3 for row in self.appearance):
            raise ConfigError(
                f"evidence.appearance must have {classes} rows of {classes} probabilities that sum to 1, "
                f"not {self.appearance}"
            )


@dataclass(frozen=True, kw_only=True)
class ConfidenceModel:
    """Models of the confidence and covariance of answers, fitted on validation queries.

    Attributes:
        known_heading, searched_heading: models by the last stage of the search ("retrieval", "vdr", "lpo").
        position_factor: covariance (m²) of the position over the inverse of the cost's curvature, for known headings.
        position_factor_searched, heading_factor: the same of the position (m²) and the heading (radians²), for
            searched headings.
    """

    known_heading: dict[str, LogisticModel]
    searched_heading: dict[str, LogisticModel]
    position_factor: float | None = None
    position_factor_searched: float | None = None
    heading_factor: float | None = None

    def fit_probability(self, stage: str, signals: Mapping[str, float], *, heading_known: bool) -> float | None:
        """Return the probability that a picture is of the plan; None for a stage that the model was not fitted on."""
        model = (self.known_heading if heading_known else self.searched_heading).get(stage)
        return None if model is None else model.probability(**signals)


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
        confidence: models of the confidence; None leaves answers without one.
        evidence: weights of the matching cost.
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
    confidence: ConfidenceModel | None = None
    evidence: MatchingWeights = field(default_factory=MatchingWeights)
    errors: PredictionErrors | None = None
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    files: dict[str, FileEntry] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION

    def evidence_for(self, *, view: bool) -> MatchingWeights:
        """Return the weights of the matching cost for spheres or for views."""
        own = None if self.view is None or not view else self.view.evidence
        return self.evidence if own is None else own

    def confidence_for(self, *, view: bool) -> ConfidenceModel | None:
        """Return the models of the confidence for spheres or for views."""
        own = None if self.view is None or not view else self.view.confidence
        return self.confidence if own is None else own

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
        """Read the manifest of a bundle; files are checked when they are read.

        Raises:
            BundleError: the manifest is missing or not valid.
        """
        path = folder / MANIFEST_NAME
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise BundleError(f"no model bundle at '{folder}': {error.strerror} ({MANIFEST_NAME})") from error
        manifest = Manifest.from_json(text)
        return cls(folder, manifest, manifest.sha256)

    def check(self) -> None:
        """Check size and digest of every file.

        Raises:
            BundleError: a file is missing or altered.
        """
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


def default_bundle() -> Path:
    """Return the folder of the model that ships: in this checkout, else the installed one.

    If the working folder is the checkout, the path is relative, so that recorded commands work elsewhere.
    """
    checkout = Path(__file__).resolve().parents[2] / _CHECKOUT
    if (checkout / MANIFEST_NAME).is_file():
        return _CHECKOUT if _CHECKOUT.resolve() == checkout else checkout
    with suppress(PackageNotFoundError):
        for file in distribution("lalaloc").files or []:
            path = Path(file.locate()).resolve()
            if path.name == MANIFEST_NAME and path.parent.match(f"*/{_INSTALLED}"):
                return path.parent
    # Opening it raises an error that names the folder.
    return checkout


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
