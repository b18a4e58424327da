"""Kinds of photographs, with known and unknown heading, for which localisability is predicted."""

from __future__ import annotations

from typing import Literal, cast, get_args

Photograph = Literal["sphere", "phone", "three_phone"]
HeadingState = Literal["known", "unknown"]
Condition = Literal[
    "sphere_known_heading",
    "phone_known_heading",
    "three_phone_known_heading",
    "sphere_unknown_heading",
    "phone_unknown_heading",
    "three_phone_unknown_heading",
]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)
# Photographs, with the number of views of 80° that each consists of; 0 for spheres.
PHOTOGRAPHS: dict[Photograph, int] = {"sphere": 0, "phone": 1, "three_phone": 3}
# The condition that needs help most, which remedies are measured on.
HARDEST: Condition = "phone_unknown_heading"


def condition_of(photograph: Photograph, heading: HeadingState) -> Condition:
    """Return the condition of a photograph."""
    return cast(Condition, f"{photograph}_{heading}_heading")


def parts_of(condition: Condition) -> tuple[Photograph, HeadingState]:
    """Return photograph and heading of a condition."""
    photograph, heading = condition.removesuffix("_heading").rsplit("_", 1)
    return cast(Photograph, photograph), cast(HeadingState, heading)
