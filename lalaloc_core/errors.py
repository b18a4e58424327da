"""The exception tree. Every error carries the values it speaks of.

LaLaLocError
├── InvalidInputError            the caller's data is wrong (a 4xx over HTTP, exit code 2 on the command line)
│   ├── InvalidFloorPlanError    a plan cannot be what it says; names the room
│   ├── InvalidPanoramaError     a picture that is not a usable 360° panorama
│   └── InvalidPoseError         a position, heading or height outside its limits
├── ConfigError                  unknown key or value of a wrong type in a configuration
├── BundleError                  a model bundle is missing, incomplete or was altered
├── CheckpointError              a checkpoint is missing or belongs to another configuration
└── ExportError                  an exported network disagrees with the one it was exported from
"""

from __future__ import annotations


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


class InvalidPanoramaError(InvalidInputError):
    """A picture is not a full equirectangular panorama this project can read."""


class InvalidPoseError(InvalidInputError):
    """A position, heading or height lies outside its limits."""


class ConfigError(LaLaLocError, ValueError):
    """A configuration has an unknown key or a value of the wrong type."""


class BundleError(LaLaLocError):
    """A model bundle is missing, incomplete, or does not match its manifest."""


class CheckpointError(LaLaLocError):
    """A checkpoint is missing or belongs to another configuration."""


class ExportError(LaLaLocError):
    """An exported network disagrees with the one it was exported from."""
