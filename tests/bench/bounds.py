"""Cramér-Rao bounds of a map, against the readable reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.geometries import cube, tetrahedron
from magloc import core
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.bounds.over_moments import sigma_table
from magloc.directions import moments_on_sphere
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved

TITLE = "bounds: one source with one of 51 moments, in a cube of 40 m; peer: the NumPy reference on a sample"
N_MOMENTS = 51
EARTH_T = (2e-5, 1e-6, 4.5e-5)


def arrays() -> dict[str, SensorArray]:
    """Constant axes and noise; axes that turn with the field; noise that depends on the field."""

    def uncertain(array: SensorArray) -> SensorArray:
        sensors = tuple(replace(s, misalignment_rad=1e-4, gain_uncertainty=1e-4) for s in array.sensors)
        return SensorArray(sensors, ambient_T=EARTH_T)

    scalar = replace(cube(1.5, kind="scalar", noise_T=1e-11), ambient_T=EARTH_T)
    return {
        "4 vector sensors": tetrahedron(1.5),
        "8 scalar sensors": scalar,
        "8 scalar sensors, uncertain ambient field": replace(scalar, ambient_uncertainty_T=1e-7),
        "4 vector sensors of uncertain axes": uncertain(tetrahedron(1.5)),
        "8 vector sensors of uncertain axes": uncertain(cube(1.5)),
    }


def rows(size: Size) -> Iterator[Row]:
    """Ours with all threads and with one; NumPy with one."""
    threads = core.threads()
    for name, array in arrays().items():
        positions = np.random.default_rng(8).uniform(-20.0, 20.0, (size.rows, 3))
        moments = moments_on_sphere(100.0, N_MOMENTS, half=not array.channel_is_scalar.any())
        sample = positions[: size.sample]

        def ours(array=array, positions=positions, moments=moments):
            return sigma_table(array, positions, moments)

        def reference(array=array, sample=sample, moments=moments):
            return cramer_rao_bounds(array, sample[:, None], moments)

        timings = interleaved(
            {
                "ours": Contestant(ours, threads, len(positions) * N_MOMENTS),
                "one thread": Contestant(ours, 1, len(positions) * N_MOMENTS),
                "reference": Contestant(reference, 1, len(sample) * N_MOMENTS),
            },
            size.rounds,
        )
        difference = np.abs(ours().range_m[: len(sample)] / reference().sigma_range_m - 1.0).max()
        yield Row(f"{name}, {threads} thr.", timings["ours"])
        agreement = f"σ of the range differ by {difference:.0e}"
        yield Row(name, timings["one thread"], "NumPy reference", timings["reference"], agreement)
