"""What a joint fit says of sources that few rows tell apart, or do not."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.surveying.fit.joint_fit import JointFit, Sources

ROWS = 22


@pytest.mark.parametrize("number", [1, 3, 4, 6])
def test_few_rows(number: int) -> None:
    """Significance is what least squares lose without a source, nothing where others explain all; σ are finite."""
    rng = np.random.default_rng(number)
    J, moments = rng.normal(size=(ROWS, number, 6)), rng.normal(size=(number, 3))
    information = np.einsum("nki,nlj->kilj", J, J).reshape(6 * number, 6 * number)
    fit = JointFit(*3 * [None], Sources(np.zeros((number, 3)), moments))  # type: ignore[arg-type]
    vars(fit)["information"] = information  # in place of that of a record
    lost = []
    for k, moment in enumerate(moments):
        own, others = J[:, k, 3:] @ moment, np.delete(J, k, axis=1).reshape(ROWS, -1)
        lost.append(np.sum((own - others @ np.linalg.lstsq(others, own)[0]) ** 2))
    np.testing.assert_allclose(fit.significance, lost, rtol=1e-6, atol=1e-6)
    assert (np.diagonal(fit.covariance) > 0.0).all()
    if 6 * number > ROWS:
        assert np.diagonal(fit.covariance).max() > 1e6  # undetermined, and says so


def test_twins_are_one() -> None:
    """Where they are together, with both moments; those farther apart than a source's own length stay."""
    places = np.array([[0.0, 0.0, -1.0], [5.0, 0.0, -1.0], [0.1, 0.0, -1.0], [5.0, 0.4, -1.0]])
    moments = np.array([[9.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-8.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    found = Sources(places, moments).without_twins(np.full(4, 0.3))
    np.testing.assert_allclose(found.position_m, [[0.05, 0.0, -1.0], places[1], places[3]])
    np.testing.assert_allclose(found.moment_Am2, [[1.0, 0.0, 2.0], moments[1], moments[3]])
