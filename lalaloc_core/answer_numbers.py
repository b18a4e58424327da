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
_HEADING = AfterValidator(lambda value: round(value, 2) % 360.0)
HeadingDeg = Annotated[float, _HEADING]
HEADING_MEANING = "azimuth of the photograph's centre, clockwise from the plan's +y seen from above"
Heading = Annotated[float, Field(ge=0, lt=360, description=f"The {HEADING_MEANING}."), _HEADING]
Degrees = Annotated[float, Field(ge=0), _rounded(2)]
# An angle of either sign.
SignedDegrees = Annotated[float, _rounded(2)]
Milliseconds = Annotated[float, _rounded(2)]
# Progress and probabilities, from 0 to 1.
Share = Annotated[float, Field(ge=0, le=1), _rounded(4)]
Score = Annotated[float, _rounded(4)]
# Probability of one place among thousands.
Mass = Annotated[float, Field(ge=0, le=1), _rounded(6)]
Cost = Annotated[
    float,
    Field(
        ge=0,
        description="Matching cost between the walls around the pose and the photograph, dimensionless; lower is "
        "better. Candidates are ranked by it and by hints. Candidates that were refined less than the first come last, "
        "and their costs are not comparable with the others.",
    ),
    _rounded(4),
]
LatentDistance = Annotated[
    float,
    Field(ge=0, le=2, description="Distance between the latents of the pose's layout and of the photograph."),
    _rounded(4),
]
