"""Truth files: what is read and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from arrays.io.errors import InputError
from magloc.truth import read_truth
from tests.written import WriteFile, writer

write = writer("truth.csv")


class TestTruth:
    """Truth files have positions, and moments where they are known."""

    def test_plane(self, write: WriteFile) -> None:
        truth = read_truth(write("time_s,x_m,y_m\n0,1,2\n1,3,4\n"))
        np.testing.assert_array_equal(truth.position_m, [[1.0, 2.0, math.nan], [3.0, 4.0, math.nan]])
        assert truth.moment_Am2 is None

    def test_space_and_moment(self, write: WriteFile) -> None:
        truth = read_truth(write("time_s,x_m,y_m,z_m,mx_Am2,my_Am2,mz_Am2\n0,1,2,3,4,5,6\n"))
        np.testing.assert_array_equal(truth.position_m, [[1.0, 2.0, 3.0]])
        assert truth.moment_Am2 is not None
        np.testing.assert_array_equal(truth.moment_Am2, [[4.0, 5.0, 6.0]])

    def test_axis_and_own_error(self, write: WriteFile) -> None:
        truth = read_truth(write("time_s,x_m,y_m,z_m,axis_x,axis_y,axis_z,sigma_m\n0,1,2,3,0,0.6,0.8,0.00015\n"))
        assert truth.moment_Am2 is None
        assert truth.axis is not None
        assert truth.sigma_m is not None
        np.testing.assert_allclose(truth.axis, [[0.0, 0.6, 0.8]], rtol=0, atol=1e-15)
        assert truth.sigma_m.tolist() == [0.00015]

    @pytest.mark.parametrize(
        ("content", "fragment"),
        [
            ("time_s,x_m,y_m,axis_x,axis_y,axis_z\n0,1,2,0,3,4\n", "line 2, column axis_x: found an axis of length 5"),
            ("time_s,x_m,y_m,sigma_m\n0,1,2,-1\n", "line 2, column sigma_m: found a negative number"),
            (
                "time_s,x_m,y_m,mx_Am2,my_Am2,mz_Am2,axis_x,axis_y,axis_z\n0,1,2,1,0,0,1,0,0\n",
                "found moments and axes",
            ),
            ("time_s,x_m\n0,1\n", "column y_m"),
            ("time_s,x_m,y_m,mx_Am2\n0,1,2,3\n", "column my_Am2"),
            ("time_s,x_m,y_m,speed\n0,1,2,3\n", "column speed"),
            ("time_s,x_m,y_m\n0,1,\n", "line 2, column y_m"),
            ("time_s,x_m,y_m\n0,1,2\n0,3,4\n", "line 3, column time_s"),
        ],
    )
    def test_bad_file(self, write: WriteFile, content: str, fragment: str) -> None:
        with pytest.raises(InputError, match=fragment):
            read_truth(write(content))
