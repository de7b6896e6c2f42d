"""Tests of magloc.convergence.filters_cuda: a start ends as it does on a processor.

| what | who checks it |
|---|---|
| the kernel as one lane of it, what a device's thread runs | all lanes together: to the last bit |
| which thread computes which start, in which part of the workspace | numba's simulator of a device, as plain Python |
| the device | the processor, where a device is present |
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import cuda
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from arrays.array import SensorArray
from magloc.convergence.filters import DampedFilter, IekfFilter, RepeatedFilter, field_weights
from magloc.convergence.filters_compiled import DAMPED, IEKF, REPEATED, Ends, Rules, Workspace, ends, n_rows, run_every
from magloc.convergence.linearisation_compiled import Model
from magloc.convergence.workspace_compiled import LANES
from tests.magloc.convergence.test_filters_compiled import TETRAHEDRON, any_array, problem, starts_of

REPOSITORY = Path(__file__).resolve().parents[3]
Array = NDArray[np.float64]
N_STARTS = 70  # more than a warp has lanes, and the last ones are not a whole warp
METHODS = (IekfFilter(max_iterations=3), RepeatedFilter(max_iterations=3), DampedFilter(max_iterations=3))
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
# Written by a process whose numba simulates a device: the ends of `starts.npy` by every method, one after the other.
SIMULATED = """
import sys
from dataclasses import replace
import numpy as np
from tests.magloc.convergence.test_filters_cuda import METHODS
from tests.magloc.convergence.test_filters_compiled import TETRAHEDRON, problem
starts = np.load(sys.argv[1])
np.savez(sys.argv[2], *(a for f in METHODS for a in replace(f, device="cuda").run(*problem(TETRAHEDRON), starts)))
"""


def by_single_lanes(code: int, model: Model, starts: Array, rules: Rules) -> Ends:
    """Every start, by threads of one lane each, two warps with a workspace each."""
    n, n_threads = len(starts), 2 * LANES
    out = Ends(np.empty((n, 6)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.bool_))
    sizes = [LANES * rows for rows in (*n_rows(model), n_rows(model)[2])]
    spaces = [Workspace(*map(np.zeros, sizes)) for _ in range(2)]
    for thread in range(n_threads):
        run_every(code, starts, thread, n_threads, rules, model, spaces[thread // LANES], out, thread % LANES)
    return out


def assert_near(found: Ends, expected: Ends) -> None:
    """The same passes; sums that a processor rounds once and another twice."""
    assert_allclose(found.states, expected.states, rtol=1e-8, atol=1e-8)
    assert_allclose(found.chi2, expected.chi2, rtol=1e-6, atol=1e-9)
    assert_array_equal(found.iterations, expected.iterations)
    assert_array_equal(found.stopped, expected.stopped)


class TestOneLane:
    @pytest.mark.slow
    @pytest.mark.parametrize("code", [IEKF, REPEATED, DAMPED])
    @pytest.mark.parametrize("array", [TETRAHEDRON, any_array(3, 5)], ids=["contrasts", "rows"])
    def test_ends_as_in_all_of_them(self, array: SensorArray, code: int) -> None:
        measurement, z = problem(array)
        model = Model.of(z, measurement.variance, array.positions, field_weights(measurement), 3.0, 300.0)
        unit = np.repeat([model.length, model.moment], 3)
        kinds = ("source", "cube with moment")
        starts = np.concatenate([starts_of(kind, N_STARTS // 2, array) for kind in kinds])
        damping = 1.0 if code == DAMPED else 0.0
        tolerance = 1e-12 / (model.moment / model.length**3)
        alone = by_single_lanes(code, model, starts / unit, Rules(damping, tolerance**2, 200.0))
        together = ends(code, model, starts, 1e-12, 200, damping)
        assert together.stopped.any()
        assert_array_equal(alone.states * unit, together.states)
        for one, other in zip(alone[1:], together[1:], strict=True):
            assert_array_equal(one, other)


class TestDevice:
    def test_simulated(self, tmp_path: Path) -> None:
        """Which thread computes which start, in which part of the workspace."""
        starts = starts_of("source", N_STARTS)
        np.save(tmp_path / "starts.npy", starts)
        command = [sys.executable, "-c", SIMULATED, tmp_path / "starts.npy", tmp_path / "ends.npz"]
        simulator = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
        subprocess.run(command, env={**os.environ, **simulator}, cwd=REPOSITORY, check=True)
        with np.load(tmp_path / "ends.npz") as file:
            found = [file[f"arr_{i}"] for i in range(4 * len(METHODS))]
        for i, method in enumerate(METHODS):
            assert_near(Ends(*found[4 * i : 4 * i + 4]), method.run(*problem(TETRAHEDRON), starts))

    @pytest.mark.skipif(not cuda.is_available(), reason="needs an NVIDIA device and libNVVM")
    @each_method
    def test_real(self, method: IekfFilter | RepeatedFilter | DampedFilter) -> None:
        starts = starts_of("source", 100_000)
        inputs = problem(TETRAHEDRON)
        assert_near(replace(method, device="cuda").run(*inputs, starts), method.run(*inputs, starts))

    @pytest.mark.skipif(cuda.is_available(), reason="there is a device")
    @each_method
    def test_none(self, method: IekfFilter | RepeatedFilter | DampedFilter) -> None:
        with pytest.raises(ValueError, match="Input device must be cpu where numba finds no NVIDIA device"):
            replace(method, device="cuda").run(*problem(TETRAHEDRON), starts_of("source", 1))

    def test_another_word(self) -> None:
        with pytest.raises(ValueError, match="Input device must be one of cpu, cuda; instead received 'gpu'"):
            IekfFilter(device="gpu")

    def test_sequential_relinearisation(self) -> None:
        with pytest.raises(ValueError, match="Input device must be cpu for relinearise_every_scalar"):
            RepeatedFilter(relinearise_every_scalar=True, device="cuda")
