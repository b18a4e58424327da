"""Number types of answers, with the digits that the HTTP API rounds them to; plain floats in the core."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field


def _rounded(digits: int) -> AfterValidator:
    # Adding 0.0 turns -0.0 into 0.0.
    return AfterValidator(lambda value: round(value, digits) + 0.0)


# Measured and computed numbers are rounded to the digits that carry information: millimetres, mm², 0.01°. Uploaded and
# configured numbers are returned unchanged.
Metres = Annotated[float, _rounded(3)]
SquareMetres = Annotated[float, _rounded(3)]
Variance = Annotated[float, _rounded(6)]
HeadingDeg = Annotated[float, AfterValidator(lambda value: round(value, 2) % 360.0)]
Degrees = Annotated[float, Field(ge=0), _rounded(2)]
# An angle of either sign.
SignedDegrees = Annotated[float, _rounded(2)]
Milliseconds = Annotated[float, _rounded(2)]
# Progress and probabilities, from 0 to 1.
Share = Annotated[float, Field(ge=0, le=1), _rounded(4)]
Score = Annotated[float, _rounded(4)]
# Probability of one place among thousands.
Mass = Annotated[float, Field(ge=0, le=1), _rounded(6)]
