"""Names of the rules for the step of an ellipsoid to a strip."""

from __future__ import annotations

from typing import Literal, get_args

StepRule = Literal["lemma", "optimal", "tightened"]
STEP_RULES: tuple[StepRule, ...] = get_args(StepRule)
