"""What a survey takes of readings before anything is fitted."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.typing import FloatArray
from magloc.readings import Readings
from magloc.surveying.preparation import varying


class TestBaseStation:
    TIME_S = np.arange(0.0, 100.0)
    AMBIENT_T = np.tile([2e-5, 0.0, -4e-5], (100, 1))

    def varying(self, time_s: FloatArray) -> FloatArray:
        """With a base station that drifts by a nanotesla a second and reads at some times."""
        base = Readings(47e-6 + 1e-9 * time_s[:, None], time_s=time_s)
        return varying(self.AMBIENT_T, self.TIME_S, base)

    def test_the_modulus_varies_about_the_given(self) -> None:
        change = np.linalg.norm(self.varying(self.TIME_S), axis=1) - np.linalg.norm(self.AMBIENT_T, axis=1)
        np.testing.assert_allclose(change, 1e-9 * (self.TIME_S - 49.5), atol=1e-18)

    def test_what_it_reads_at_other_times_does_not_matter(self) -> None:
        """An hour after the survey, and at a third of its rate."""
        hour = np.arange(0.0, 3600.0, 3.0)
        np.testing.assert_allclose(self.varying(hour), self.varying(self.TIME_S), rtol=0.0, atol=1e-18)

    @pytest.mark.parametrize("unit", [1e-3, 1e3])
    def test_another_unit_is_refused(self, unit: float) -> None:
        base = Readings(unit * np.full((100, 1), 47e-6), time_s=self.TIME_S)
        with pytest.raises(ValueError, match="Input base must read the modulus of the Earth's field, about 44721 nT"):
            varying(self.AMBIENT_T, self.TIME_S, base)
