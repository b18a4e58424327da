"""Model bundle: manifest, fitted parameters, measured errors, and the files of the networks.

Begin with `bundle.py`, which reads and describes a bundle. `fitted_parameters.py` has the parameters of the matching
cost and the confidence, and the measured errors of the networks.
"""

from lalaloc_core.bundle.bundle import (
    BUNDLE_FILES,
    COHORT,
    DECODER_WEIGHTS,
    DETECTOR_ONNX,
    HEAD_ONNX,
    IMAGE_ONNX,
    IMAGE_WEIGHTS,
    LAYOUT_ONNX,
    LAYOUT_WEIGHTS,
    OBJECTS_ONNX,
    VIEW_ONNX,
    VIEW_WEIGHTS,
    Bundle,
    Manifest,
    ObjectsManifest,
    ViewManifest,
    write_manifest,
)
from lalaloc_core.bundle.fitted_parameters import (
    AlbumWeights,
    ConfidenceModel,
    LogisticModel,
    MatchingWeights,
    PredictionErrors,
)
from lalaloc_core.files import MANIFEST_NAME, default_bundle
