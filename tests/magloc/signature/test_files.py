"""The table and the JSON of a signature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magloc.signature.files import json_of_signature, lines_of_depths
from tests.magloc.signature.test_signature import DIAGONAL, fitted, four_passes, moments


def test_a_variance_that_rounding_has_made_negative_has_no_standard_deviation() -> None:
    passes = four_passes()
    found = fitted(passes, [moments(p, DIAGONAL) for p in passes])
    sigma = found.sigma_Am2
    without = replace(found, covariance=np.outer(sigma, sigma) * (11.0 * np.eye(sigma.size) - 10.0))
    for signature, is_known in ((found, True), (without, False)):
        predicted = np.array([one["sigma_nT"] for one in json_of_signature(signature, [9.0])["predicted"]])  # type: ignore[attr-defined]
        assert np.isfinite(predicted).all() == is_known
        assert not (predicted <= 0.0).any()
    negative = replace(found, covariance=-found.covariance)
    assert all(line.split()[3] == "nan" for line in lines_of_depths(negative, [9.0])[1:])
