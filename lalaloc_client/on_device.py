"""Features of photographs, computed on this device with the service's image encoder; needs the extra `onnx`."""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from lalaloc_client.answers import DroppedFrames, FilmReading, SequenceLocalisation
from lalaloc_client.errors import OnDeviceError
from lalaloc_client.options import Options, ViewOptions
from lalaloc_client.requests import Photograph, picture_file

if TYPE_CHECKING:
    from lalaloc_core.localise.encode.features import FeatureEncoder
    from lalaloc_core.photograph import StatedCamera

Film: TypeAlias = "bytes | str | os.PathLike[str]"
_CAMERA = frozenset(ViewOptions.__optional_keys__)


@dataclass(frozen=True)
class TurnFeatures:
    """Features of the photographs of a turn, or of the frames of a film, and the angles that features cannot tell.

    Attributes:
        features: a file for each photograph, or frame that was kept.
        relative_heading_deg: headings relative to the first photograph, None where unknown; None if none is known.
    """

    features: list[bytes]
    relative_heading_deg: list[float | None] | None = None
    relative_heading_std_deg: float | None = None
    times_s: tuple[float, ...] | None = None
    film: FilmReading | None = None


class OnDeviceModel:
    """Image encoder of a service's model, cached on disk by the model's digest.

    The files lie in `lalaloc/models` of the user's cache folder (`XDG_CACHE_HOME`, or `~/.cache`).
    """

    def __init__(self, manifest: bytes) -> None:
        """Read the manifest that the service sent."""
        try:
            from lalaloc_core.bundle import MANIFEST_NAME, Bundle, Manifest
            from lalaloc_core.errors import BundleError
            from lalaloc_core.localise.encode.features import DEVICE_FILES
        except ImportError as error:
            raise OnDeviceError(
                f"on_device=True needs the package '{error.name}': pip install 'lalaloc[onnx]'"
            ) from error
        try:
            parsed = Manifest.from_json(manifest.decode())
        except (BundleError, UnicodeDecodeError) as error:
            raise OnDeviceError(f"the service's model cannot be read: {error}") from error
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        self._bundle = Bundle(cache / "lalaloc" / "models" / parsed.sha256, parsed, parsed.sha256)
        self._files = [name for name in DEVICE_FILES if name != MANIFEST_NAME and name in parsed.files]
        self._encoder: FeatureEncoder | None = None

    def missing(self) -> list[str]:
        """Return the names of the files that are not in the cache, or damaged there."""
        from lalaloc_core.errors import BundleError

        missing = []
        for name in self._files:
            try:
                self._bundle.read(name)
            except BundleError:
                missing.append(name)
        return missing

    def store(self, name: str, content: bytes) -> None:
        """Write a file to the cache, whole or not at all."""
        expected = self._bundle.manifest.files[name].sha256
        if (digest := hashlib.sha256(content).hexdigest()) != expected:
            raise OnDeviceError(f"the service sent '{name}' with the SHA-256 {digest}; its manifest states {expected}")
        folder = self._bundle.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Not of a fixed name, because several processes may write the same file.
            part, path = tempfile.mkstemp(prefix=name, suffix=".part", dir=folder)
            try:
                with os.fdopen(part, "wb") as file:
                    file.write(content)
                Path(path).replace(folder / name)
            except BaseException:
                Path(path).unlink(missing_ok=True)
                raise
        except OSError as error:
            raise OnDeviceError(f"'{folder / name}' cannot be written: {error.strerror}") from error

    def load(self) -> None:
        """Load the networks."""
        from lalaloc_core.errors import BundleError
        from lalaloc_core.localise.encode.features import FeatureEncoder

        try:
            self._encoder = FeatureEncoder(self._bundle)
        except BundleError as error:
            raise OnDeviceError(str(error)) from error

    def features(self, photograph: Photograph, options: Mapping[str, Any]) -> bytes:
        """Return the features of a photograph, given options about its camera; `load` comes first."""
        from lalaloc_core.errors import InvalidPhotographError
        from lalaloc_core.localise.encode.features import is_features
        from lalaloc_core.photograph import open_photograph

        assert self._encoder is not None
        content = picture_file(photograph)
        if is_features(content):
            return content
        try:
            return self._encoder.features(open_photograph(content, stated=_stated_camera(options), **self._sizes()))
        except InvalidPhotographError as error:
            raise OnDeviceError(str(error)) from error

    def turn(self, turn: Film | Sequence[Photograph], options: Mapping[str, Any]) -> TurnFeatures:
        """Return the features of a film of a turn, or of its photographs in order; `load` comes first.

        Photographs of which one is a sphere, or is features already, have no angles.
        """
        from lalaloc_core.errors import InvalidFilmError, InvalidPhotographError

        try:
            if isinstance(turn, (bytes, str, os.PathLike)):
                return self._film(turn if isinstance(turn, bytes) else Path(turn).read_bytes(), options)
            return self._photographs(turn, options)
        except (InvalidFilmError, InvalidPhotographError) as error:
            raise OnDeviceError(str(error)) from error

    def _film(self, content: bytes, options: Mapping[str, Any]) -> TurnFeatures:
        from lalaloc_core.photograph.film import read_film
        from lalaloc_core.photograph.turned import stated_headings

        assert self._encoder is not None
        film = read_film(content, stated=_stated_camera(options), patch_size=self._sizes()["patch_size"])
        headings_deg, std_deg = stated_headings(film.angles)
        return TurnFeatures(
            [self._encoder.features(photograph) for photograph in film.photographs],
            headings_deg,
            std_deg,
            film.times_s,
            FilmReading(
                frames_read=film.frames,
                frames_kept=len(film.photographs),
                dropped=tuple(DroppedFrames(reason, frames) for reason, frames in film.dropped.items()),
                duration_s=film.duration_s,
                turned_deg=math.degrees(film.turned),
                warnings=film.warnings,
            ),
        )

    def _photographs(self, photographs: Sequence[Photograph], options: Mapping[str, Any]) -> TurnFeatures:
        from lalaloc_core.localise.encode.features import is_features
        from lalaloc_core.photograph import open_photograph
        from lalaloc_core.photograph.turned import open_turn, stated_headings

        assert self._encoder is not None
        contents, stated = [picture_file(photograph) for photograph in photographs], _stated_camera(options)
        sizes = self._sizes()

        def overlaps(content: bytes) -> bool:
            return not (is_features(content) or open_photograph(content, stated=stated, **sizes).is_sphere)

        if not all(map(overlaps, contents)):
            return TurnFeatures([self.features(content, options) for content in contents])
        opened, angles = open_turn(contents, stated, **sizes)
        return TurnFeatures([self._encoder.features(view) for view in opened], *stated_headings(angles))

    def _sizes(self) -> dict[str, Any]:
        """Return the sizes in which the model reads photographs."""
        from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size

        return {"sphere_size": sphere_size(self._bundle.manifest), "patch_size": patch_size(self._bundle.manifest)}


def filmed(answer: SequenceLocalisation, sent: TurnFeatures) -> SequenceLocalisation:
    """Return an answer to the features of a film as one to the film, with the times of its poses."""
    assert sent.times_s is not None
    poses = (replace(pose, time_s=time_s) for pose, time_s in zip(answer.poses, sent.times_s, strict=True))
    return replace(answer, poses=tuple(poses), film=sent.film)


def split_options(options: Options) -> tuple[dict[str, Any], Options]:
    """Return the options about the camera, which features contain, and all others."""
    camera = {name: value for name, value in options.items() if name in _CAMERA and value is not None}
    return camera, cast("Options", {name: value for name, value in options.items() if name not in _CAMERA})


def _stated_camera(options: Mapping[str, Any]) -> StatedCamera:
    from lalaloc_core.photograph import Intrinsics, StatedCamera

    intrinsics = options.get("intrinsics")
    return StatedCamera(**{**options, "intrinsics": None if intrinsics is None else Intrinsics(**intrinsics)})
