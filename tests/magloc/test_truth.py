"""Truth files: what is read and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from arrays.io.errors import InputError
from magloc.truth import Truth, cause_of_disagreement, read_truth
from tests.command_line import Run
from tests.conftest import REPOSITORY
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


class TestDisagreement:
    """Each mistake of a truth file is named; errors of the results alone are not."""

    TIME_S = np.arange(60.0)

    @pytest.fixture
    def path_m(self) -> np.ndarray:
        """Path that is not alike from any two sides."""
        t = self.TIME_S
        return np.stack([0.02 * t, np.sin(0.17 * t), 0.5 * np.cos(0.11 * t) + 0.3], axis=1)

    def cause(self, stated_m: np.ndarray, path_m: np.ndarray, lag_s: float = 0.0) -> str:
        found = path_m + 2e-3 * np.random.default_rng(0).normal(size=path_m.shape)
        return cause_of_disagreement(Truth(self.TIME_S + lag_s, stated_m, name="truth.csv"), self.TIME_S, found)

    def test_errors_alone(self, path_m: np.ndarray) -> None:
        assert self.cause(path_m, path_m) == ""

    def test_large_errors_without_a_cause(self, path_m: np.ndarray) -> None:
        other = np.random.default_rng(1).normal(size=path_m.shape)
        assert self.cause(other, path_m) == ""

    def test_unit(self, path_m: np.ndarray) -> None:
        assert "taken for millimetres" in self.cause(1e3 * path_m, path_m)

    @pytest.mark.parametrize("lag_s", [-7.3, 4.0])
    def test_clock(self, path_m: np.ndarray, lag_s: float) -> None:
        assert f"{lag_s:.3g} s is subtracted from its time_s" in self.cause(path_m, path_m, lag_s)

    def test_origin(self, path_m: np.ndarray) -> None:
        assert "shifted by (-1" in self.cause(path_m + np.array([1.0, 0.0, 0.0]), path_m)

    def test_turned(self, path_m: np.ndarray) -> None:
        turned = path_m @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        assert "turned by 90° and shifted" in self.cause(turned, path_m)

    def test_mirrored(self, path_m: np.ndarray) -> None:
        assert "mirrored" in self.cause(path_m * [1.0, 1.0, -1.0], path_m)

    def test_outliers(self, path_m: np.ndarray) -> None:
        """A tenth of the fixes at another place does not hide the cause."""
        found = path_m.copy()
        found[::10] += 5.0
        turned = path_m @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        assert "turned by 90°" in cause_of_disagreement(Truth(self.TIME_S, turned), self.TIME_S, found)

    @pytest.mark.slow_after(2)
    @pytest.mark.parametrize("command", ["locate", "track", "calibrate"])
    def test_by_the_commands(self, tmp_path: Path, run: Run, command: str) -> None:
        folder = REPOSITORY / "magloc" / "datasets"
        lines = (folder / "board-truth.csv").read_text(encoding="utf-8").splitlines()
        place = [lines[0].split(",").index(name) for name in ("x_m", "y_m", "z_m")]
        rows = [line.split(",") for line in lines[1:]]
        for row in rows:
            for column in place:
                row[column] = str(1e3 * float(row[column]))
        truth, readings = tmp_path / "truth.csv", tmp_path / "board.csv"
        truth.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n", encoding="utf-8")
        first = (folder / "board.csv").read_text(encoding="utf-8").splitlines(keepends=True)[:31]
        readings.write_text("".join(first), encoding="utf-8")
        out = tmp_path / ("out.toml" if command == "calibrate" else "out")
        array = folder / "board-array.toml"
        outcome = run(command, readings, "--array", array, "--truth", truth, "--out", out)
        assert "truth.csv: found positions" in outcome.err
        assert "taken for millimetres" in outcome.err
