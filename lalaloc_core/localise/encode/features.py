"""Features: outputs of the image encoders for a photograph, in a file that replaces the picture in a query.

A file has 4 bytes "LLFT", the version (uint16) and the length of the header (uint32), the header in JSON, and the
arrays of `_layout` in float32; all numbers are little-endian. docs/reference/features.md describes it. Lengths in
metres are for a camera height of 1 m, because most outputs scale with it; `at_height` scales them. Version 2 adds the
objects in photographs that are no spheres; version 1 can still be read.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import IMAGE_ONNX, MANIFEST_NAME, OBJECTS_ONNX, VIEW_ONNX, Bundle, Manifest, MatchingWeights
from lalaloc_core.configuration import build_config
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI
from lalaloc_core.errors import (
    BundleError,
    ConfigError,
    ForeignFeaturesError,
    InvalidFeaturesError,
    InvalidPhotographError,
)
from lalaloc_core.localise.encode.exported_network import PROFILE_OUTPUTS, SHARE_OUTPUT
from lalaloc_core.localise.encode.sphere_encoder import SphereEncoder
from lalaloc_core.localise.encode.view_encoder import OBJECT_OUTPUTS, ObjectEncoder, ViewEncoder
from lalaloc_core.photograph import Assumed, Intrinsics, Photograph, PhotographFeatures, StatedCamera
from lalaloc_core.photograph.cameras import Camera, Fisheye, Perspective
from lalaloc_core.photograph.projection import Source
from lalaloc_core.photograph.stated_camera import Projection, camera_of_intrinsics, intrinsics_of

# Bytes of a file, and pixels of a side, that of the flattest pictures which are decoded.
MAX_BYTES, MAX_SIDE = 2**18, 2**21
# Files of a bundle that `FeatureEncoder` reads, those that it has.
DEVICE_FILES = (MANIFEST_NAME, IMAGE_ONNX, VIEW_ONNX, OBJECTS_ONNX)
_MAGIC, _VERSION, _PREFIX = b"LLFT", 2, struct.Struct("<4sHI")
_VERSION_WITHOUT_OBJECTS = 1
_MAX_HEADER_BYTES, _MAX_PATCHES = 2**14, 16
_MAX_WARNINGS, _MAX_WARNING_CHARACTERS = 8, 300
# Camera heights (m) of the rings. The ring is the only output that depends on the height other than by its log.
RING_HEIGHTS_M = (0.5, 1.0, 1.5, 2.0, 3.0)
# Modes of the distance that the encoder of views predicts at each azimuth.
_VIEW_MODES = 2
_WALLS = (*PROFILE_OUTPUTS, SHARE_OUTPUT)
# Ranges of the values, far beyond those of real ones; logs of lengths and of scales, then unbounded outputs.
_LOGS, _OUTPUTS = (-12.0, 12.0), (-1e4, 1e4)
_SHARE = (-1e-3, 1.0 + 1e-3)
_RANGES = {
    "log_share": (-1e4, 1e-3),
    "seen": _SHARE,
    "ring": _OUTPUTS,
    "object_probability": _SHARE,
    "object_azimuth": (-math.pi - 1e-3, math.pi + 1e-3),
}


@dataclass(frozen=True, kw_only=True)
class _Angle:
    value_deg: float
    std_deg: float
    source: Source


@dataclass(frozen=True, kw_only=True)
class _CameraModel:
    width: int
    height: int
    intrinsics: Intrinsics


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Header of a file.

    Attributes:
        model: SHA-256 of the model's bundle.
        projection, projection_source, hfov, pitch, roll: what was assumed about the photograph, as in `Photograph`.
        wall_direction: as in `Photograph`; files of earlier versions have none.
        seen_deg: first and last azimuth that the photograph shows, relative to its centre.
        patches: azimuth of each patch relative to the photograph's centre, in columns; empty for a full sphere.
        compass_deg: compass heading of the centre.
        camera: camera of perspective and fisheye photographs.
        warnings: as in `Photograph`.
    """

    model: str
    projection: Projection
    projection_source: Source
    hfov: _Angle
    pitch: _Angle
    roll: _Angle
    seen_deg: tuple[float, float]
    wall_direction: _Angle | None = None
    patches: list[int] = field(default_factory=list)
    compass_deg: float | None = None
    camera: _CameraModel | None = None
    warnings: list[str] = field(default_factory=list)


def device_manifest(manifest: Manifest) -> Manifest:
    """Return the parts of a manifest that `FeatureEncoder` needs; the bundle keeps its digest."""
    view = manifest.view
    return dataclasses.replace(
        manifest,
        confidence=None,
        evidence=MatchingWeights(),
        errors=None,
        training={},
        metrics={},
        view=None if view is None else dataclasses.replace(view, evidence=None, confidence=None, errors=None),
    )


class FeatureEncoder:
    """Image encoders of a bundle, which turn photographs into features; safe to share between threads.

    It reads no other file of the bundle, so that a device needs the manifest and the image encoders only.
    """

    def __init__(self, bundle: Bundle, *, threads: int = 0) -> None:
        if not gives_features(bundle.manifest):
            raise BundleError(
                f"model '{bundle.manifest.name}' (architecture '{bundle.manifest.architecture}') gives no features; "
                "send the photograph instead"
            )
        self._bundle = bundle
        self._spheres = SphereEncoder(bundle, threads=threads, outputs_only=True)
        self._views = None if bundle.manifest.view is None else ViewEncoder(bundle, threads=threads)
        self._objects = None if bundle.manifest.objects is None else ObjectEncoder(bundle, threads=threads)

    def features(self, photograph: Photograph) -> bytes:
        """Return the features of a decoded photograph as a file.

        Raises:
            InvalidPhotographError: the model gives no features of such photographs.
        """
        manifest = self._bundle.manifest
        if photograph.sphere is not None and encodes_spheres(manifest):
            by_height = [self._spheres.outputs(photograph.sphere, height_m) for height_m in RING_HEIGHTS_M]
            outputs = by_height[RING_HEIGHTS_M.index(1.0)] | {"ring": np.stack([row["ring"] for row in by_height])}
        elif photograph.sphere is None and self._views is not None:
            outputs = self._views.outputs([patch.rgba for patch in photograph.patches], 1.0)
            if self._objects is not None:
                outputs |= self._objects.outputs(photograph)
        else:
            raise InvalidPhotographError(
                f"the photograph is {photograph.projection}, of which model '{manifest.name}' gives no features; send "
                "the photograph itself"
            )
        return write_features(photograph, outputs, self._bundle)


def write_features(photograph: Photograph, outputs: Mapping[str, np.ndarray], bundle: Bundle) -> bytes:
    """Return outputs of the image encoders for a photograph as a file; without objects, one of version 1."""
    text = json.dumps(dataclasses.asdict(_header_of(photograph, bundle)), allow_nan=False).encode()
    has_objects = bundle.manifest.objects is None or outputs.keys() >= set(OBJECT_OUTPUTS)
    version = _VERSION if has_objects or photograph.is_sphere else _VERSION_WITHOUT_OBJECTS
    shapes = _layout(bundle.manifest, len(photograph.patch_azimuths), version)
    arrays = (np.asarray(outputs[name], "<f4").reshape(shape).tobytes() for name, shape in shapes.items())
    return _PREFIX.pack(_MAGIC, version, len(text)) + text + b"".join(arrays)


def is_features(content: bytes) -> bool:
    """Return whether a file begins as features do."""
    return content.startswith(_MAGIC)


def gives_features(manifest: Manifest) -> bool:
    """Return whether a model gives features of any photographs."""
    return manifest.view is not None or encodes_spheres(manifest)


def encodes_spheres(manifest: Manifest) -> bool:
    """Return whether the encoder of spheres depends on the camera height as `at_height` presumes."""
    return bool(manifest.ring_sectors and manifest.room_types)


def read_features(content: bytes, bundle: Bundle) -> Photograph:
    """Read the features of a photograph; return it with `features` instead of pixels."""
    version, header, body = _split(content)
    manifest = bundle.manifest
    if header.model != bundle.sha256:
        raise ForeignFeaturesError(header.model[:64], manifest.name, bundle.sha256)
    photograph = _photograph_of(header, manifest)
    shapes = _layout(manifest, len(header.patches), version)
    expected = 4 * sum(math.prod(shape) for shape in shapes.values())
    if len(body) != expected:
        raise InvalidFeaturesError(
            f"the arrays have {len(body)} bytes; {expected} are needed for {len(header.patches) or 'no'} patches"
        )
    outputs, first = {}, 0
    for name, shape in shapes.items():
        count = math.prod(shape)
        outputs[name] = _checked(name, np.frombuffer(body, "<f4", count, first).astype(np.float32).reshape(shape))
        first += 4 * count
    azimuths = tuple(place * TWO_PI / manifest.profile_columns for place in header.patches)
    return dataclasses.replace(photograph, features=PhotographFeatures(outputs, azimuths))


def at_height(features: PhotographFeatures, camera_height_m: float) -> dict[str, np.ndarray]:
    """Return the outputs of an image encoder for a camera height; rings are interpolated between their heights."""
    log_height = np.float32(math.log(camera_height_m))
    outputs = dict(features.outputs)
    for name in ("log_profile", "log_ceiling"):
        outputs[name] = outputs[name] + log_height
    if "ring" in outputs:
        outputs["ring"] = _ring_at(outputs["ring"], camera_height_m)
    return outputs


def _ring_at(rings: Float[np.ndarray, "h c s"], camera_height_m: float) -> Float[np.ndarray, "c s"]:
    """Return the ring for a camera height: a polynomial in its log through all rings, constant beyond them."""
    knots = [math.log(height_m) for height_m in RING_HEIGHTS_M]
    place = min(max(math.log(camera_height_m), knots[0]), knots[-1])
    weights = [math.prod((place - knot) / (own - knot) for knot in knots if knot != own) for own in knots]
    return np.tensordot(np.array(weights, np.float32), rings, 1)


def _layout(manifest: Manifest, patches: int, version: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays, in the order of the file, of a full sphere or of some patches."""
    columns = manifest.profile_columns
    if not patches:
        modes = manifest.image_config.get("modes", 1)
        names, shape = (_WALLS[:2], (columns,)) if modes == 1 else (_WALLS, (columns, modes))
        walls = dict.fromkeys(names, shape)
        ring = (len(RING_HEIGHTS_M), manifest.layout_config["channels"], manifest.ring_sectors)
        return {"ring": ring, **walls, **_structure((), columns)}
    assert manifest.view is not None
    columns = manifest.view.sectors * columns // manifest.ring_sectors
    walls = dict.fromkeys(_WALLS, (patches, columns, _VIEW_MODES))
    names = [] if manifest.objects is None or version < _VERSION else manifest.objects.names
    objects = dict.fromkeys(OBJECT_OUTPUTS if names else (), (len(names),))
    return {**walls, "seen": (patches, columns), **_structure((patches,), columns), **objects}


def _structure(patches: tuple[int, ...], columns: int) -> dict[str, tuple[int, ...]]:
    return {
        "opening_logits": (*patches, columns, len(OPENING_CLASSES)),
        "log_ceiling": patches,
        "log_ceiling_scale": patches,
        "room_type_logits": (*patches, len(ROOM_TYPES)),
    }


def _split(content: bytes) -> tuple[int, _Header, memoryview]:
    """Return the version, the header, and the bytes of the arrays."""
    if len(content) > MAX_BYTES:
        raise InvalidFeaturesError(f"the file has {len(content)} bytes; the limit is {MAX_BYTES}")
    if len(content) < _PREFIX.size or not is_features(content):
        raise InvalidFeaturesError("the file does not begin as features do; make it with `lalaloc encode`")
    _, version, length = _PREFIX.unpack_from(content)
    if not 1 <= version <= _VERSION:
        raise InvalidFeaturesError(f"the features have version {version}; this version reads 1 to {_VERSION}")
    if length > min(_MAX_HEADER_BYTES, len(content) - _PREFIX.size):
        raise InvalidFeaturesError(
            f"the header has {length} bytes; the limit is {_MAX_HEADER_BYTES}, and the rest of the file"
        )
    end = _PREFIX.size + length
    try:
        header = build_config(_Header, json.loads(content[_PREFIX.size : end]), path="header")
    except (ConfigError, ValueError, RecursionError) as error:
        raise InvalidFeaturesError(f"not a valid header: {str(error)[:300]}") from error
    return version, header, memoryview(content)[end:]


def _header_of(photograph: Photograph, bundle: Bundle) -> _Header:
    def angle(assumed: Assumed) -> _Angle:
        return _Angle(value_deg=math.degrees(assumed.value), std_deg=math.degrees(assumed.sd), source=assumed.source)

    column = TWO_PI / bundle.manifest.profile_columns
    return _Header(
        model=bundle.sha256,
        projection=photograph.projection,
        projection_source=photograph.projection_source,
        hfov=angle(photograph.hfov),
        pitch=angle(photograph.pitch),
        roll=angle(photograph.roll),
        wall_direction=None if photograph.wall_direction is None else angle(photograph.wall_direction),
        seen_deg=(math.degrees(photograph.azimuths[0]), math.degrees(photograph.azimuths[1])),
        patches=[round(azimuth / column) for azimuth in photograph.patch_azimuths],
        compass_deg=None if photograph.compass_heading is None else math.degrees(photograph.compass_heading),
        camera=_camera_model(photograph),
        warnings=[text[:_MAX_WARNING_CHARACTERS] for text in photograph.warnings[:_MAX_WARNINGS]],
    )


def _camera_model(photograph: Photograph) -> _CameraModel | None:
    camera = photograph.camera
    if not isinstance(camera, Perspective | Fisheye):
        return None
    model = _CameraModel(width=camera.width, height=camera.height, intrinsics=intrinsics_of(camera))
    try:
        _camera_of(model, photograph.projection)
    except InvalidPhotographError:
        # Estimated cameras can be outside of the limits of stated ones. Answers then have no camera.
        return None
    return model


def _camera_of(model: _CameraModel, projection: Projection) -> Camera:
    """Return the camera of a header."""
    StatedCamera(projection=projection, intrinsics=model.intrinsics).check()
    assert projection in ("perspective", "fisheye")
    return camera_of_intrinsics(projection, model.width, model.height, model.intrinsics)


def _photograph_of(header: _Header, manifest: Manifest) -> Photograph:
    """Return the photograph of a header, without outputs."""
    half = manifest.profile_columns // 2
    walls, (first_deg, last_deg) = header.wall_direction, header.seen_deg
    angles = header.hfov, header.pitch, header.roll, walls
    faults = {
        "hfov": not 0.0 < header.hfov.value_deg <= 360.0,
        "pitch and roll": max(abs(header.pitch.value_deg), abs(header.roll.value_deg)) > 180.0,
        "wall_direction": walls is not None and not (header.patches and abs(walls.value_deg) <= 360.0),
        "std_deg": any(not 0.0 <= angle.std_deg <= 180.0 for angle in angles if angle is not None),
        "seen_deg": not (-360.0 <= first_deg < last_deg <= 360.0 and last_deg - first_deg <= 360.0),
        "compass_deg": header.compass_deg is not None and abs(header.compass_deg) > 360.0,
        "patches": len(header.patches) > _MAX_PATCHES or any(abs(place) > half for place in header.patches),
        "warnings": len(header.warnings) > _MAX_WARNINGS
        or any(len(text) > _MAX_WARNING_CHARACTERS or not text.isprintable() for text in header.warnings),
        "camera": header.camera is not None
        and not (0 < header.camera.width <= MAX_SIDE and 0 < header.camera.height <= MAX_SIDE),
    }
    for name, is_wrong in faults.items():
        if is_wrong:
            raise InvalidFeaturesError(f"{name} of the header is out of range")
    if manifest.view is None if header.patches else not encodes_spheres(manifest):
        raise InvalidFeaturesError(f"model '{manifest.name}' gives no features of {header.projection} photographs")
    if not header.patches and header.projection != "equirectangular":
        raise InvalidFeaturesError(f"the projection is '{header.projection}', and there are no patches")
    try:
        camera = None if header.camera is None else _camera_of(header.camera, header.projection)
    except InvalidPhotographError as error:
        raise InvalidFeaturesError(f"camera of the header: {error}") from error

    def assumed(angle: _Angle) -> Assumed:
        return Assumed(value=math.radians(angle.value_deg), sd=math.radians(angle.std_deg), source=angle.source)

    return Photograph(
        projection=header.projection,
        projection_source=header.projection_source,
        hfov=assumed(header.hfov),
        pitch=assumed(header.pitch),
        roll=assumed(header.roll),
        azimuths=(math.radians(first_deg), math.radians(last_deg)),
        wall_direction=None if walls is None else assumed(walls),
        camera=camera,
        compass_heading=None if header.compass_deg is None else math.radians(header.compass_deg),
        warnings=tuple(header.warnings),
    )


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    """Return an array whose values are in range."""
    low, high = _RANGES.get(name, _OUTPUTS if name.endswith("_logits") else _LOGS)
    # NaN is in no range.
    if not ((values >= low) & (values <= high)).all():
        raise InvalidFeaturesError(f"{name} has values that are no numbers from {low:g} to {high:g}")
    return values
