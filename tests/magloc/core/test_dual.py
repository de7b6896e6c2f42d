"""Dual numbers: derivatives of the dipole's field by position and moment, against the analytic ones and NumPy's."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from magloc import core
from magloc.fields import dipole

Array = NDArray[np.float64]
COMPILER = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
SOURCE = """
#include <magloc/dipole.hpp>
using namespace magloc;
using Number = Dual<Lanes, 6>;

// Fields (n, 3) of moments at the origin. Derivatives (n, 3, 6) by point and moment, by dual numbers and analytic;
// those (n, 3, 3) by the point alone, the moment being constant.
extern "C" void derivatives(const double *points, const double *moments, int n, double *b, double *dual,
                            double *analytic, double *alone) {
  for (int i = 0; i < n; i += n_lanes<Lanes>) {
    Lanes d[3], m[3], by_point[3][3], by_moment[3][3];
    Number dual_d[3], dual_m[3], dual_b[3], constant_moment[3];
    for (int a = 0; a < 3; ++a) {
      d[a] = load_component<Lanes>(points, i, n, a), m[a] = load_component<Lanes>(moments, i, n, a);
      dual_d[a] = Number::variable(d[a], a), dual_m[a] = Number::variable(m[a], 3 + a);
    }
    field(Ray<Number>::from(dual_d), dual_m, dual_b);
    field(Ray<Number>::from(dual_d), m, constant_moment);
    gradient(Ray<Lanes>::from(d), m, by_point);
    field_matrix(Ray<Lanes>::from(d), by_moment);
    for (int lane = 0; lane < n_lanes<Lanes> && i + lane < n; ++lane)
      for (int a = 0; a < 3; ++a) {
        const int row = 3 * (i + lane) + a;
        b[row] = get_lane(dual_b[a].value, lane);
        for (int k = 0; k < 3; ++k) alone[3 * row + k] = get_lane(constant_moment[a].derivative[k], lane);
        for (int k = 0; k < 6; ++k) {
          dual[6 * row + k] = get_lane(dual_b[a].derivative[k], lane);
          analytic[6 * row + k] = get_lane(k < 3 ? by_point[a][k] : by_moment[a][k - 3], lane);
        }
      }
  }
}
"""
# Lanes of each instruction set, and the option that the compiler needs.
SETS = {"double": (1, ()), "baseline": (2, ()), "avx2": (4, ("-mavx2", "-mfma")), "avx512": (8, ("-mavx512f",))}


@pytest.fixture(scope="module", params=SETS)
def library(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Compile the derivatives for an instruction set."""
    if COMPILER is None:
        pytest.skip("needs a C++ compiler")
    lanes, options = SETS[request.param]
    before = core.instruction_set()
    try:
        core.use_instruction_set("baseline" if request.param == "double" else request.param)
    except ValueError:
        pytest.skip(f"this machine or build does not have {request.param}")
    core.use_instruction_set(before)
    folder = tmp_path_factory.mktemp("dual")
    (folder / "dual.cpp").write_text(SOURCE, encoding="utf-8")
    flags = ["-std=c++17", "-O2", "-Wno-psabi", "-fno-math-errno", *options, f"-DMAGLOC_LANES={lanes}"]
    command = [COMPILER, *flags, "-shared", "-fPIC", f"-I{core.include_dir()}", "dual.cpp", "-o", "dual.so"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "dual.so"))


coordinates = st.floats(-1.0, 1.0).map(lambda x: round(x, 6))
VECTORS = arrays(np.float64, (5, 3), elements=coordinates)


class TestDual:
    @given(points=VECTORS, moments=VECTORS, exponent=st.floats(-3.0, 5.0))
    def test_derivatives_of_a_dipole(
        self, library: ctypes.CDLL, points: Array, moments: Array, exponent: float
    ) -> None:
        points = 10.0**exponent * points[np.linalg.norm(points, axis=1) > 1e-3]
        moments = np.ascontiguousarray(moments[: len(points)])
        found = np.empty((len(points), 3)), *np.empty((2, len(points), 3, 6)), np.empty((len(points), 3, 3))
        pointers = [ctypes.c_void_p(one.ctypes.data) for one in (points, moments, *found)]
        library.derivatives(*pointers[:2], len(points), *pointers[2:])
        b, dual, analytic, alone = found
        # Thirty roundings of terms up to 15 times the field and gradient of such a moment at such a distance.
        r = np.linalg.norm(points, axis=1)[:, None, None]
        m = np.linalg.norm(moments, axis=1)[:, None, None]
        unit = np.concatenate([np.repeat(m / r**4, 3, axis=2), np.repeat(1.0 / r**3, 3, axis=2)], axis=2)
        jacobian = dipole.field_jacobian(points, np.zeros(3), moments) * ([-1.0] * 3 + [1.0] * 3) / dipole.MU0_OVER_4PI
        assert (np.abs(dual - analytic) <= 1e-13 * unit).all()
        assert (np.abs(dual - jacobian) <= 1e-13 * unit).all()
        assert (np.abs(alone - jacobian[..., :3]) <= 1e-13 * unit[..., :3]).all()
        expected = dipole.field(points, np.zeros(3), moments) / dipole.MU0_OVER_4PI
        assert (np.abs(b - expected) <= 4e-15 * (m / r**3)[..., 0]).all()
