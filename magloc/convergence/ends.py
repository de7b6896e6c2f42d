"""Ends of filters from many starts, by compiled kernels.

The tests have readable filters, the reference; docs/theory/lanes.md says how the kernels differ.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc import core
from magloc.fields.dipole import MU0_OVER_4PI

ITERATED, REPEATED, DAMPED, RELINEARISED = range(4)
# One call of the kernel takes 0.05 s at most, unless the passes of the fewest starts take longer.
_BLOCK_S, _FEWEST = 0.05, 8
_TERM_S = 4e-9  # a weighted field in a difference; a contrast takes five times as long, relinearisation four times


class FilterEnds(NamedTuple):
    """Final states of a filter from many starts.

    Attributes
    ----------
    states : ndarray, shape (n, 6)
        (position [m], moment [A·m²]).
    chi2 : ndarray, shape (n,)
    iterations : ndarray of int, shape (n,)
        Passes over the readings.
    stopped : ndarray of bool, shape (n,)
        Whether the stop rule was met.
    """

    states: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    stopped: NDArray[np.bool_]


class ScaledDifferences(NamedTuple):
    """Differences of an array's fields in units of a length and a moment (magloc.h).

    The arrays of one of the two forms are empty.
    """

    length: float  # [m]
    moment: float  # [A·m²]
    sensors: FloatArray  # (N, 3)
    # Recursive contrasts, for noise that is the same along the axes of each sensor; the base sensor comes first.
    readings: FloatArray = np.zeros((0, 3))
    blend: FloatArray = np.zeros(0)
    whiten: FloatArray = np.zeros(0)
    # Sums of weighted fields, for any noise.
    weights: FloatArray = np.zeros((0, 0, 3))
    measured: FloatArray = np.zeros(0)
    variance: FloatArray = np.zeros(0)

    @property
    def field(self) -> float:
        """Unit of fields [T]."""
        return MU0_OVER_4PI * self.moment / self.length**3

    @classmethod
    def from_weights(
        cls, z: FloatArray, variance: FloatArray, sensors: FloatArray, weights: FloatArray, length: float, moment: float
    ) -> ScaledDifferences:
        """Return the differences as sums of weighted fields.

        Parameters
        ----------
        z, variance : ndarray, shape (k,)
            Differences [T] and their variances [T²].
        sensors : ndarray, shape (N, 3)
            Positions of the sensors [m].
        weights : ndarray, shape (k, N, 3)
            Weights of the fields in the differences.
        length, moment : float
            Units [m], [A·m²].
        """
        scaled = cls(length, moment, sensors / length)
        sigma, missing = np.sqrt(variance), (0, -len(z) % 3)
        return scaled._replace(
            weights=np.pad(scaled.field * weights / sigma[:, None, None], (missing, (0, 0), (0, 0))),
            measured=np.pad(z / sigma, missing),
            variance=np.pad(variance / scaled.field**2, missing),
        )

    @classmethod
    def of(
        cls, z: FloatArray, variance: FloatArray, sensors: FloatArray, weights: FloatArray, length: float, moment: float
    ) -> ScaledDifferences:
        """Return the differences as contrasts if their noise allows it.

        For the arguments see :meth:`from_weights`.
        """
        base, noise = _base_and_noise(weights, variance)
        if noise is None:
            return cls.from_weights(z, variance, sensors, weights, length, moment)
        order = np.argsort(np.arange(len(sensors)) != base, kind="stable")
        scaled = cls(length, moment, sensors[order] / length)
        noise = noise[order] / scaled.field**2
        total = np.cumsum(1.0 / noise)  # inverse variance of the mean
        readings: FloatArray = np.linalg.lstsq(weights.reshape(z.size, -1), z / scaled.field, rcond=None)[0].astype(
            float
        )
        return scaled._replace(
            readings=readings.reshape(-1, 3)[order],
            blend=1.0 / (noise * total),
            whiten=np.concatenate([[0.0], 1.0 / np.sqrt(noise[1:] + 1.0 / total[:-1])]),
        )


def _base_and_noise(weights: FloatArray, variance: FloatArray) -> tuple[int, FloatArray | None]:
    """Return the base sensor and the sensors' variances (N,).

    The latter are None unless the differences are such contrasts.

    The information of the differences about the sensors' fields must be ``(diag(c) - c cᵀ / Σc) ⊗ I₃`` with c the
    inverse variances, and the plain sum of their squares that of the differences against the base sensor.
    """
    n = weights.shape[1]
    information = np.einsum("jsa,jtb,j->satb", weights, weights, 1.0 / variance)
    squares = np.einsum("jsa,jtb->satb", weights, weights)
    base = int(np.argmax(squares[:, 0, :, 0].diagonal()))
    contrasts = np.delete(np.eye(n), base, axis=0)
    contrasts[:, base] = -1.0
    p = information[:, 0, :, 0]
    if n == 2:
        certainty = np.full(2, 2.0 * p[0, 0])
    else:
        # The off-diagonal elements are -v_i v_j with v = c / √Σc.
        i, j, k = np.arange(n), np.roll(np.arange(n), 1), np.roll(np.arange(n), 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            certainty = p[i, i] - p[i, j] * p[i, k] / p[j, k]
    if not np.all(certainty > 0.0):
        return base, None
    expected = np.diag(certainty) - np.outer(certainty, certainty) / np.sum(certainty)
    scale = np.sqrt(np.outer(certainty, certainty))[:, None, :, None]
    same = np.eye(3)[:, None, :]
    recursive = (
        np.max(np.abs(information - expected[:, None, :, None] * same) / scale) < 1e-12
        and np.max(np.abs(squares - (contrasts.T @ contrasts)[:, None, :, None] * same)) < 1e-12 * n
    )
    return base, 1.0 / certainty if recursive else None


def ends(
    method: int,
    differences: ScaledDifferences,
    starts: FloatArray,
    tolerance_T: float,
    max_iterations: int,
    first_damping: float = 0.0,
) -> FilterEnds:
    """Return the end of every start.

    Parameters
    ----------
    method : int
        ITERATED, REPEATED, DAMPED or RELINEARISED; the last one needs weighted differences.
    differences : ScaledDifferences
        In units of the prior's standard deviations, or of the process noise of a pass.
    starts : ndarray, shape (n, 6)
        States (position [m], moment [A·m²]); for ITERATED and DAMPED the mean of the prior.
    tolerance_T : float
        Stop when the differences change by less than this between passes [T].
    max_iterations : int
        Passes at most.
    first_damping : float
        Damping of the first step of DAMPED.
    """
    n, unit = len(starts), np.repeat([differences.length, differences.moment], 3)
    out = FilterEnds(np.empty((n, 6)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.uint8))
    _, _, *arrays = differences
    work = core.problem(
        "starts",
        method=method,
        n_sensors=len(differences.sensors),
        n_differences=len(differences.measured),
        max_iterations=max_iterations,
        tolerance2=(tolerance_T / differences.field) ** 2,
        first_damping=first_damping,
        **{name: np.ascontiguousarray(array) for name, array in zip(differences._fields[2:], arrays, strict=True)},
        starts=np.ascontiguousarray(starts / unit),
        **out._asdict(),
    )
    n_terms = len(differences.sensors) * (len(differences.measured) or 5) * (4 if method == RELINEARISED else 1)
    start_s = _TERM_S * n_terms * max_iterations
    core.run("filter_starts", work, n, block=max(_FEWEST, int(_BLOCK_S / start_s)))
    return out._replace(states=out.states * unit, stopped=out.stopped.astype(bool))
