"""The bench itself: its table says what was measured, and every group still runs."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from threadpoolctl import threadpool_info, threadpool_limits

from arrays.geometries import tetrahedron
from magloc import core
from magloc.fields.dipole import total_field
from magloc.measurement.differences import DifferenceMeasurement
from tests.bench import fields, filters, memory
from tests.bench.__main__ import GROUPS, report
from tests.bench.fixes import simulated
from tests.bench.table import Row, ratio_text, table, time_text
from tests.bench.timing import Contestant, Size, Timing, installed, interleaved
from tests.fuzz.cases import commands

QUICK = {"fields", "fixes"}
TINY = Size(points=30, rows=2, problems=1, grid=2, sample=1, rounds=1)


class TestTable:
    @pytest.mark.parametrize(
        ("seconds", "text"),
        [
            ((2.0, 2.0, 2.0), "2.00 s +0%"),
            ((1.1e-2, 1.0e-2, 1.2e-2), "10.0 ms +10%"),
            ((1.234e-4,), "123 µs +0%"),
            ((9.99e-7,), "999 ns +0%"),
        ],
    )
    def test_a_time_has_the_best_and_the_medians_distance_from_it(self, seconds, text):
        assert time_text(Timing(seconds)) == text

    def test_a_ratio_pairs_the_rounds(self):
        # A machine that gets three times slower for one round slows both: the ratio stays.
        assert ratio_text(Timing((1.0, 3.0, 1.0)), Timing((4.0, 12.0, 4.0))) == "4.00 (4.00-4.00)"

    def test_a_ratio_has_the_median_and_the_range(self):
        assert ratio_text(Timing((1.0, 1.0, 2.0)), Timing((2.0, 1234.0, 1.0))) == "2.00 (0.500-1234)"

    def test_columns_line_up(self):
        text = table([("a group", [Row("one", Timing((1.0,)), "peer", Timing((2.0,))), Row("another row", note="n")])])
        first, title, *rest = text.splitlines()
        assert title.startswith("-- a group ---")
        bars = [[i for i, c in enumerate(line) if c == "|"] for line in (first, *rest)]
        assert bars[0] == bars[1] == bars[2]

    def test_a_peer_that_is_not_here_is_said_so(self):
        assert Row("one", Timing((1.0,)), "peer").cells == ("one", "1.00 s +0%", "peer not installed", "", "")


class TestInterleaved:
    def test_takes_turns_after_one_uncounted_call_each(self, monkeypatch):
        monkeypatch.setattr("tests.bench.timing.SAMPLE_S", 1e-9)
        order = []
        contestants = {name: Contestant(lambda name=name: order.append(name)) for name in "AB"}
        interleaved(contestants, 3)
        assert "".join(order) == "AB" + "ABABAB"

    def test_sets_the_threads_and_restores_them(self):
        """Left with more threads of BLAS, whatever comes later spends most of its time on waiting for them."""

        def threads():
            of_blas = (each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas")
            return core.threads(), *of_blas

        with threadpool_limits(2, user_api="blas"):
            before = threads()
            seen = []
            interleaved({"A": Contestant(lambda: seen.append(threads()))}, 1)
            assert {max(numbers) for numbers in seen} == {1}
            assert threads() == before

    def test_divides_by_the_units_of_work(self, monkeypatch):
        seconds = itertools.count()  # one from each look at the clock to the next
        clock = SimpleNamespace(perf_counter=lambda: float(next(seconds)))
        monkeypatch.setattr("tests.bench.timing.time", clock)
        assert interleaved({"A": Contestant(lambda: None, count=1000)}, 1)["A"].best == 1e-3


class TestPeersHaveTheSameProblem:
    @pytest.mark.parametrize("peer", fields.PEERS)
    def test_field(self, peer):
        if not installed(peer):
            pytest.skip(f"{peer} is not installed (extra bench)")
        rng = np.random.default_rng(0)
        points, sources, moments = rng.normal(size=(5, 3)), rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
        field = total_field(points, sources, moments)
        # The peers' magnetic constants differ from ours by up to 6e-10.
        found = fields.in_tesla(fields.PEERS[peer](points, sources, moments)())
        assert_allclose(found, field, rtol=1e-9, atol=1e-9 * np.abs(field).max())

    def test_filter_step(self):
        measurement = DifferenceMeasurement.of(tetrahedron(1.5, noise_T=1e-9))
        truths, readings = simulated(measurement, 1, np.random.default_rng(0))
        z, x = measurement.measured(readings)[0], truths[0] + np.repeat([0.1, 5.0], 3)
        once, iterated = (filters.our_step(measurement, z, x, n)() for n in (1, filters.ITERATIONS))
        assert_allclose(filters.filterpy_step(measurement, z, x)(), once, rtol=1e-6)
        assert_allclose(filters.stonesoup_step(measurement, z, x)(), iterated, rtol=1e-6)

    def test_stone_soup_linearises_as_often(self, monkeypatch):
        count = []
        jacobian = DifferenceMeasurement.jacobian
        monkeypatch.setattr(
            DifferenceMeasurement, "jacobian", lambda *arguments: count.append(1) or jacobian(*arguments)
        )
        measurement = DifferenceMeasurement.of(tetrahedron(1.5, noise_T=1e-9))
        truths, readings = simulated(measurement, 1, np.random.default_rng(0))
        z, x = measurement.measured(readings)[0], truths[0] + np.repeat([0.1, 5.0], 3)
        filters.stonesoup_step(measurement, z, x)()
        assert len(count) == filters.ITERATIONS


class TestMemory:
    def test_has_every_command(self):
        assert set(memory.CASES) == {name for name, _ in commands()}

    def test_a_longer_log_goes_on_in_time(self, tmp_path):
        log = tmp_path / "log.csv"
        log.write_text("time_s,a\n1.0,x\n1.5,y\n")
        memory.lengthen(log, 5)
        rows = log.read_text().split()
        assert rows == ["time_s,a", *(f"{t:.6f},{a}" for t, a in zip((1.0, 1.5, 2.0, 2.5, 3.0), "xyxyx", strict=True))]

    def test_a_peak_is_what_the_command_held_and_not_the_one_that_starts_it(self, tmp_path):
        held = np.ones(60_000_000)  # 480 MB
        assert memory._run("magloc new-array a.toml --shape tetrahedron --size-m 1.5 --noise-nT 1", tmp_path) < 2e8
        assert held.nbytes > 4e8

    @pytest.mark.parametrize(("peaks", "text"), [((5e7, 5.1e7), "flat"), ((5e7, 7.7e7), "30,000 bytes a row")])
    def test_the_slope_is_of_the_two_sizes(self, peaks, text):
        assert memory.told([int(peak) for peak in peaks], [100, 1000], "row").endswith(text)


@pytest.mark.parametrize(
    "group", [pytest.param(group, marks=[] if group in QUICK else pytest.mark.slow) for group in GROUPS]
)
def test_group_runs(group, monkeypatch):
    monkeypatch.setattr("tests.bench.timing.SAMPLE_S", 1e-9)
    monkeypatch.setattr("tests.bench.attitude.N_RUNS", 2)
    monkeypatch.setattr("tests.bench.memory.CASES", {"magloc new-array": memory.CASES["magloc new-array"]})
    lines = report([group], TINY).splitlines()
    assert any(line.startswith(f"-- {GROUPS[group].TITLE}") for line in lines)
    assert "|" in lines[-1]


@pytest.mark.parametrize("group", ["fields", "maps", pytest.param("filters", marks=pytest.mark.slow)])
def test_group_runs_without_its_peers(group, monkeypatch):
    monkeypatch.setattr("tests.bench.timing.SAMPLE_S", 1e-9)
    monkeypatch.setattr(f"tests.bench.{group}.installed", lambda package: package in {"magloc", "scipy"})
    assert "not installed" in report([group], TINY).split("\n\n")[1]
