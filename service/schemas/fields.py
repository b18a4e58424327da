"""The base of all answers, and the types of their numbers."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Finite = Field(allow_inf_nan=False)


def _rounded(digits: int) -> AfterValidator:
    # Without the minus of what rounds to zero.
    return AfterValidator(lambda value: round(value, digits) + 0.0)


# What is measured or computed is told in millimetres, mm² and hundredths of a degree: what comes after says nothing.
# What was uploaded, and what was set, is told as it was.
Metres = Annotated[float, _rounded(3)]
SquareMetres = Annotated[float, _rounded(3)]
Variance = Annotated[float, _rounded(6)]
HeadingDeg = Annotated[float, AfterValidator(lambda value: round(value, 2) % 360.0)]
Degrees = Annotated[float, Field(ge=0), _rounded(2)]
Milliseconds = Annotated[float, _rounded(2)]
# From 0 to 1: how much is done, and probabilities.
Share = Annotated[float, Field(ge=0, le=1), _rounded(4)]
Score = Annotated[float, _rounded(4)]
# Of one place among thousands.
Mass = Annotated[float, Field(ge=0, le=1), _rounded(6)]


class ResponseModel(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(frozen=True, extra="forbid")
