"""Values of options that several commands take; what argparse does not check itself."""

from __future__ import annotations

import argparse


def count(text: str) -> int:
    """A whole number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} must be at least 1")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} must be positive")
    return value


def processes(text: str) -> int:
    """A number of worker processes; 0 works in this one."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} must be at least 0")
    return value


def heading(text: str) -> float:
    """A heading in degrees, from -360 to 360."""
    value = float(text)
    if not -360.0 <= value <= 360.0:
        raise argparse.ArgumentTypeError(f"{text} must lie from -360 to 360 degrees")
    return value


def tolerance(text: str) -> float:
    """How far off a heading may be in degrees, from 0 to 45."""
    value = float(text)
    if not 0.0 <= value <= 45.0:
        raise argparse.ArgumentTypeError(f"{text} must lie from 0 to 45 degrees")
    return value
