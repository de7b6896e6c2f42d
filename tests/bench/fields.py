"""Field of dipoles at many points, against choclo, harmonica and magpylib."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np

from magloc import core
from magloc.fields.dipole import total_field
from magloc.fields.points import field_at_points
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, installed, interleaved

TITLE = "field: induction of dipoles at points"


def rows(size: Size) -> Iterator[Row]:
    """Compiled against compiled with all threads; magpylib has one, so there ours has one too."""
    threads = core.threads()
    for n_points, n_dipoles in ((size.points, 1), (size.points, 20), (10 * size.points, 1)):
        rng = np.random.default_rng(1)
        points = rng.uniform(-1.0, 1.0, (n_points, 3))
        sources = rng.uniform(1.0, 2.0, (n_dipoles, 3))
        moments = rng.normal(size=(n_dipoles, 3))
        peers = {name: peer(points, sources, moments) for name, peer in PEERS.items() if installed(name)}
        field = field_at_points(points, sources, moments)
        difference = {name: np.abs(in_tesla(run()) - field).max() / np.abs(field).max() for name, run in peers.items()}
        contestants = {
            "ours": Contestant(lambda p=points, s=sources, m=moments: field_at_points(p, s, m), threads),
            "ours, 1 thread": Contestant(lambda p=points, s=sources, m=moments: field_at_points(p, s, m)),
            "ours, NumPy": Contestant(lambda p=points, s=sources, m=moments: total_field(p, s, m)),
            **{name: Contestant(run, 1 if name in ONE_THREAD else threads) for name, run in peers.items()},
        }
        timings = interleaved(contestants, size.rounds)
        what = f"{n_points:,} points, {n_dipoles} dipole{'s' * (n_dipoles > 1)}"
        for name in PEERS:
            one = name in ONE_THREAD
            yield Row(
                f"{what}, {1 if one else threads} thr.",
                timings["ours, 1 thread" if one else "ours"],
                name,
                timings.get(name),
                f"fields differ by {difference[name]:.0e}" if name in difference else "",
            )
        yield Row(
            f"{what}, NumPy twin", timings["ours, NumPy"], "magpylib", timings.get("magpylib"), "neither is compiled"
        )


def in_tesla(field: object) -> np.ndarray:
    """Induction (N, 3) of what a peer returns, outside the measured time."""
    return 1e-9 * np.stack(field, axis=-1) if isinstance(field, tuple) else field


Field = Callable[[], object]


@cache
def choclo_loop() -> Callable[..., None]:
    """choclo has the field of one dipole at one point; this loop around it is compiled by numba."""
    import numba
    from choclo.dipole import magnetic_field

    # Not cached on disk: numba would not see that another choclo has been installed.
    @numba.njit(parallel=True, error_model="numpy", fastmath={"contract"})
    def fill(points, sources, moments, out):
        for i in numba.prange(points.shape[0]):
            x = y = z = 0.0
            for k in range(sources.shape[0]):
                bx, by, bz = magnetic_field(
                    points[i, 0], points[i, 1], points[i, 2],
                    sources[k, 0], sources[k, 1], sources[k, 2],
                    moments[k, 0], moments[k, 1], moments[k, 2],
                )  # fmt: skip
                x += bx
                y += by
                z += bz
            out[i, 0], out[i, 1], out[i, 2] = x, y, z

    return fill


def choclo_field(points: np.ndarray, sources: np.ndarray, moments: np.ndarray) -> Field:
    """Induction in T, shape (N, 3)."""
    fill = choclo_loop()

    def run() -> np.ndarray:
        out = np.empty(points.shape)
        fill(points, sources, moments, out)
        return out

    return run


def harmonica_field(points: np.ndarray, sources: np.ndarray, moments: np.ndarray) -> Field:
    """Three components in nT, from coordinates that each have an array of their own."""
    from harmonica import dipole_magnetic

    arguments = [tuple(np.ascontiguousarray(a.T)) for a in (points, sources, moments)]
    return lambda: dipole_magnetic(*arguments, field="b", parallel=True)


def magpylib_field(points: np.ndarray, sources: np.ndarray, moments: np.ndarray) -> Field:
    """Induction in T, shape (N, 3), from magpylib's fields of single dipoles in A/m."""
    from magpylib.core import dipole_Hfield

    repeated = np.repeat(moments[:, None, :], len(points), axis=1)

    def run() -> np.ndarray:
        total = np.zeros(points.shape)
        for source, moment in zip(sources, repeated, strict=True):
            total += dipole_Hfield(points - source, moment)
        total *= 4e-7 * np.pi
        return total

    return run


PEERS = {"choclo": choclo_field, "harmonica": harmonica_field, "magpylib": magpylib_field}
ONE_THREAD = {"magpylib"}
