"""Types of option values shared by several commands, with range checks."""

from __future__ import annotations

import argparse


def count(text: str) -> int:
    """Parse an integer of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is out of range; it must be at least 1")
    return value


def positive(text: str) -> float:
    """Parse a finite number above 0."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is out of range; it must be positive")
    return value


def processes(text: str) -> int:
    """Parse a number of worker processes; 0 runs everything in this process."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is out of range; it must be at least 0")
    return value


def heading(text: str) -> float:
    """Parse a heading in degrees, from -360 to 360."""
    value = float(text)
    if not -360.0 <= value <= 360.0:
        raise argparse.ArgumentTypeError(f"{text} is out of range; it must be between -360 and 360 degrees")
    return value


def tolerance(text: str) -> float:
    """Parse the tolerance of a heading in degrees, from 0 to 45."""
    value = float(text)
    if not 0.0 <= value <= 45.0:
        raise argparse.ArgumentTypeError(f"{text} is out of range; it must be between 0 and 45 degrees")
    return value
