"""Words by which a complementary filter, and what stands in for its second vector, are chosen."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["explicit", "gauss-newton", "adaptive"]
METHODS: tuple[Method, ...] = get_args(Method)
Rule = Literal["magnetometer-only", "raw", "transported"]
RULES: tuple[Rule, ...] = get_args(Rule)
Magnet = Literal["auto", "subtracted", "rejected", "kept"]
MAGNETS: tuple[Magnet, ...] = get_args(Magnet)
