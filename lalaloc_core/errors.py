"""The exception tree. Every error carries the values it speaks of.

LaLaLocError
├── InvalidInputError            the caller's data is wrong (a 4xx over HTTP, exit code 2 on the command line)
│   ├── InvalidFloorPlanError    a plan cannot be what it says; names the room
│   │   └── SeveralLevelsError   a file has several storeys, and none was chosen; names them
│   ├── MissingExtraError        a format that needs a package which is not installed; names the extra
│   ├── InvalidPanoramaError     a picture that is not a usable 360° panorama
│   ├── InvalidPoseError         a position, heading or height outside its limits
│   ├── InvalidHintError         what is said to be known of a place cannot be; names the hint
│   ├── InvalidMotionError       a motion between two pictures that cannot have been measured
│   └── DatasetError             a data set's file is missing, damaged or impossible; names scene, room and path
├── ConfigError                  unknown key or value of a wrong type in a configuration
├── BundleError                  a model bundle is missing, incomplete or was altered
├── CheckpointError              a checkpoint is missing or belongs to another configuration
├── ExportError                  an exported network disagrees with the one it was exported from
└── RunError                     an evaluation run is missing, damaged, or was made with other settings
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

# Of the storeys of a tower, so many are named in a sentence.
_SHOWN_LEVELS = 12


class LaLaLocError(Exception):
    """Base of every error this project raises on purpose."""


class InvalidInputError(LaLaLocError, ValueError):
    """The caller's data is wrong; the message names the value and the limit."""


class InvalidFloorPlanError(InvalidInputError):
    """A floor plan breaks a rule.

    Attributes:
        room: name of the room at fault, None when the fault lies in the plan as a whole.
        reason: what is wrong, with value and limit.
    """

    def __init__(self, reason: str, *, room: str | None = None) -> None:
        self.room = room
        self.reason = reason
        super().__init__(f"room '{room}': {reason}" if room is not None else reason)


class SeveralLevelsError(InvalidFloorPlanError):
    """A file has several storeys where one plan is wanted.

    Attributes:
        levels: their names, lowest first.
    """

    def __init__(self, levels: Sequence[str]) -> None:
        self.levels = tuple(levels)
        shown = ", ".join(f"'{level}'" for level in self.levels[:_SHOWN_LEVELS])
        more = f" and {len(self.levels) - _SHOWN_LEVELS} more" if len(self.levels) > _SHOWN_LEVELS else ""
        super().__init__(f"the file has {len(self.levels)} levels: {shown}{more}; choose one with `level`")


class MissingExtraError(InvalidInputError):
    """A format cannot be read or written here: the package that does is not installed.

    Attributes:
        what: was to be done.
        extra: of this project, which brings the package.
    """

    def __init__(self, what: str, extra: str) -> None:
        self.what, self.extra = what, extra
        super().__init__(
            f"{what} needs the extra `{extra}`, which is not installed here: pip install 'lalaloc[{extra}]'"
        )


class InvalidPanoramaError(InvalidInputError):
    """A picture is not a full equirectangular panorama this project can read."""


class InvalidPoseError(InvalidInputError):
    """A position, heading or height lies outside its limits."""


class InvalidHintError(InvalidInputError):
    """What is said to be known of a place beforehand cannot be meant.

    Attributes:
        hint: name of the hint at fault.
        reason: what is wrong, with value and limit.
    """

    def __init__(self, hint: str, reason: str) -> None:
        self.hint, self.reason = hint, reason
        super().__init__(f"{hint}: {reason}")


class InvalidMotionError(InvalidInputError):
    """A motion between two pictures lies outside its limits, or misses a part."""


class DatasetError(InvalidInputError):
    """A file of a data set is missing, damaged, or says what cannot be.

    Attributes:
        reason: what is wrong, with value and limit.
        scene, room: where; None when the fault lies above them.
        path: the file at fault, None when there is no single one.
    """

    def __init__(
        self, reason: str, *, scene: str | None = None, room: str | None = None, path: Path | None = None
    ) -> None:
        self.reason, self.scene, self.room, self.path = reason, scene, room, path
        where = [f"scene '{scene}'"] if scene is not None else []
        where += [f"room '{room}'"] if room is not None else []
        where += [f"'{path}'"] if path is not None else []
        super().__init__(f"{', '.join(where)}: {reason}" if where else reason)

    def __reduce__(self) -> tuple[Callable[..., DatasetError], tuple[object, ...]]:
        """Errors of worker processes arrive whole."""
        return _dataset_error, (self.reason, self.scene, self.room, self.path)


def _dataset_error(reason: str, scene: str | None, room: str | None, path: Path | None) -> DatasetError:
    return DatasetError(reason, scene=scene, room=room, path=path)


class ConfigError(LaLaLocError, ValueError):
    """A configuration has an unknown key or a value of the wrong type."""


class BundleError(LaLaLocError):
    """A model bundle is missing, incomplete, or does not match its manifest."""


class CheckpointError(LaLaLocError):
    """A checkpoint is missing or belongs to another configuration."""


class ExportError(LaLaLocError):
    """An exported network disagrees with the one it was exported from."""


class RunError(LaLaLocError):
    """An evaluation run is missing, damaged, or was made with other settings."""
