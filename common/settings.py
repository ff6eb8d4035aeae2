"""What every section of the configuration is made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]


def _ordered(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError("the first number must not be above the second")
    return bounds


def _bounded(limit: float) -> AfterValidator:
    def check(bounds: tuple[float, float]) -> tuple[float, float]:
        if bounds[0] < 0 or bounds[1] > limit:
            raise ValueError(f"both numbers must lie in [0, {limit:g}]")
        return bounds

    return AfterValidator(check)


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
"""Lowest and highest value of a quantity that is drawn uniformly."""
Shares = Annotated[Range, _bounded(1.0)]
Levels = Annotated[Range, _bounded(255.0)]
"""Of a pixel."""


class Section(BaseModel):
    """A group of settings: immutable, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)
