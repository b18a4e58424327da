"""Exceptions of the core. Messages name the wrong value and the limit; `service.errors` adds those of the service."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Largest number of levels named in a message.
_SHOWN_LEVELS = 12


class LaLaLocError(Exception):
    """Base of every error this project raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, so that errors of worker processes keep their attributes, whatever their constructor."""
        return _unpickled, (type(self), self.args, vars(self))


def _unpickled(kind: type[LaLaLocError], arguments: tuple[Any, ...], attributes: dict[str, Any]) -> LaLaLocError:
    error = kind.__new__(kind, *arguments)
    vars(error).update(attributes)
    return error


class InvalidInputError(LaLaLocError, ValueError):
    """The caller's data are wrong: a 4xx over HTTP, exit code 2 on the command line."""


class InvalidFloorPlanError(InvalidInputError):
    """A floor plan breaks a rule.

    Attributes:
        room: name of the invalid room, None if the plan as a whole is invalid.
        reason: problem, with value and limit.
    """

    def __init__(self, reason: str, *, room: str | None = None) -> None:
        self.room = room
        self.reason = reason
        super().__init__(f"room '{room}': {reason}" if room is not None else reason)


class SeveralLevelsError(InvalidFloorPlanError):
    """A file has several levels and none was chosen.

    Attributes:
        levels: names of the levels, lowest first.
    """

    def __init__(self, levels: Sequence[str]) -> None:
        self.levels = tuple(levels)
        shown = ", ".join(f"'{level}'" for level in self.levels[:_SHOWN_LEVELS])
        more = f" and {len(self.levels) - _SHOWN_LEVELS} more" if len(self.levels) > _SHOWN_LEVELS else ""
        super().__init__(f"the file has {len(self.levels)} levels: {shown}{more}; choose one with `level`")


def install_command(extra: str) -> str:
    """Return the command that adds an extra of this project to an installation in its folder."""
    return f".venv/bin/pip install -c constraints.txt -e '.[{extra}]'"


class MissingExtraError(InvalidInputError):
    """A format cannot be read or written because its package is not installed.

    Attributes:
        action: the attempted action, for the message.
        extra: extra of this project that brings the package.
    """

    def __init__(self, action: str, extra: str) -> None:
        self.action, self.extra = action, extra
        super().__init__(f"{action} needs the extra `{extra}`, which is not installed; run {install_command(extra)}")


class InvalidPhotographError(InvalidInputError):
    """A picture is not a usable photograph, or a statement about it is invalid."""


class InvalidFilmError(InvalidInputError):
    """A film cannot be read, exceeds a limit, or shows nothing."""


class InvalidFeaturesError(InvalidInputError):
    """Features of a photograph are damaged, of another version, or out of range."""


class ForeignFeaturesError(InvalidInputError):
    """Features of a photograph were computed with another model."""

    def __init__(self, given: str, name: str, expected: str) -> None:
        super().__init__(
            f"the features are of the model with the SHA-256 {given}, not of '{name}', {expected}: compute them anew "
            "with that model"
        )


class InvalidPoseError(InvalidInputError):
    """A position, heading or height is outside its limits."""


class InvalidHintError(InvalidInputError):
    """A hint about the pose is invalid.

    Attributes:
        hint: name of the invalid hint.
        reason: problem, with value and limit.
    """

    def __init__(self, hint: str, reason: str) -> None:
        self.hint, self.reason = hint, reason
        super().__init__(f"{hint}: {reason}")


class InvalidMotionError(InvalidInputError):
    """A motion between two photographs is outside its limits or incomplete."""


class InvalidCorrectionError(InvalidInputError):
    """A correction of a pin is incomplete, out of range, or names what the plan does not have."""


class InvalidEntryError(LaLaLocError):
    """The stored entry of a photograph of an album is damaged, too large, or of another version."""


class InvalidStateError(LaLaLocError):
    """The state of a tracked camera is damaged, of another version, or of another grid."""


class DatasetError(InvalidInputError):
    """A file of a data set is missing, damaged or invalid.

    Attributes:
        reason: problem, with value and limit.
        scene, room: location of the problem; None if it concerns more than one.
        path: the file, None if there is no single one.
    """

    def __init__(
        self, reason: str, *, scene: str | None = None, room: str | None = None, path: Path | None = None
    ) -> None:
        self.reason, self.scene, self.room, self.path = reason, scene, room, path
        location = [f"scene '{scene}'"] if scene is not None else []
        location += [f"room '{room}'"] if room is not None else []
        location += [f"'{path}'"] if path is not None else []
        super().__init__(f"{', '.join(location)}: {reason}" if location else reason)


class ConfigError(LaLaLocError, ValueError):
    """A configuration has an unknown key or a value of the wrong type."""


class BundleError(LaLaLocError):
    """A model bundle is missing, incomplete, or does not match its manifest."""


class CheckpointError(LaLaLocError):
    """A checkpoint is missing or belongs to another configuration."""


class ExportError(LaLaLocError):
    """An exported network disagrees with its source."""


class RunError(LaLaLocError):
    """An evaluation run is missing, damaged, or has other settings."""
