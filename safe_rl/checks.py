"""The values that arguments may have: names for ranges, and the base class that checks them.

Constructors annotate their arguments with the types of ``pydantic`` and ``annotated_types``,
``lr: PositiveFloat`` or ``size: Annotated[int, Interval(ge=1, le=100)]``.
"""

from __future__ import annotations

from typing import Annotated

from annotated_types import Interval

from safe_rl.ranges import Checked, Text

__all__ = ["Checked", "Fraction", "Share", "Text", "Weight"]

Share = Annotated[float, Interval(ge=0, le=1)]
Fraction = Annotated[float, Interval(gt=0, le=1)]
"""A share above 0."""
Weight = Annotated[float, Interval(ge=0, lt=1)]
"""A share below 1, such as the weight of the past in a moving average."""
