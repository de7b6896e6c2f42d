"""Names of complementary filters, of substitutions and of ways to treat a magnet."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["explicit", "gauss-newton", "adaptive"]
METHODS: tuple[Method, ...] = get_args(Method)
Rule = Literal["magnetometer-only", "raw", "transported"]
RULES: tuple[Rule, ...] = get_args(Rule)
Magnet = Literal["auto", "subtracted", "rejected", "kept"]
MAGNETS: tuple[Magnet, ...] = get_args(Magnet)
