"""Guaranteed observer of a linear system with bounded disturbances and bounded errors of readings.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019;
the factor and the enlargement are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adcs.ellipsoids.ellipsoid import Ellipsoid, measurement_direction, shape_matrix
from adcs.ellipsoids.names import STEP_RULES, StepRule
from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc import core

IntArray = NDArray[np.int64]
INFLATION = 1.5
_RUNS_A_BLOCK = 4000


@dataclass(frozen=True, eq=False)
class BoundedSystem:
    """Linear system with bounded noise.

    Attributes
    ----------
    A : ndarray, shape (n, n)
        Transition matrix; may be unstable.
    disturbance : ndarray, shape (n, n)
        Q, shape of the ellipsoid of the disturbances: rank one for a segment, zero for no disturbance.
    directions : ndarray, shape (m, n)
        H, measured direction of each channel.
    bounds : ndarray, shape (m,)
        c, largest error of each channel, positive.

    Raises
    ------
    ValueError
        The sizes do not match, Q is not positive semidefinite, a direction is zero, or a bound is not positive.

    Examples
    --------
    A number that changes by at most 0.1 per step and is read with an error of at most 0.1:

    >>> import numpy as np
    >>> import adcs
    >>> system = adcs.BoundedSystem(np.eye(1), 0.01 * np.eye(1), np.eye(1), np.array([0.1]))
    >>> system.bounds
    array([0.1])
    """

    A: FloatArray
    disturbance: FloatArray
    directions: FloatArray
    bounds: FloatArray

    def __post_init__(self) -> None:
        A = np.array(self.A, dtype=np.float64)
        if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0 or not np.isfinite(A).all():
            raise ValueError(f"Input A must be a square matrix of finite numbers; instead received shape {A.shape}.")
        n = len(A)
        directions = np.array([measurement_direction(h, n) for h in np.atleast_2d(self.directions)])
        bounds = np.array(np.atleast_1d(self.bounds), dtype=np.float64)
        for c in bounds:
            check_positive(bounds=c)
        if len(bounds) != len(directions):
            raise ValueError(f"Input bounds must be {len(directions)} numbers; instead received {len(bounds)}.")
        object.__setattr__(self, "A", A)
        object.__setattr__(self, "disturbance", shape_matrix(self.disturbance, n, "disturbance"))
        object.__setattr__(self, "directions", directions)
        object.__setattr__(self, "bounds", bounds)

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.A)

    @property
    def m(self) -> int:
        """Number of channels."""
        return len(self.directions)


class EllipsoidObserver:
    """Observer of many runs of one system: its sets contain the states with certainty.

    Parameters
    ----------
    system : BoundedSystem
        System and bounds of its noise.
    start : Ellipsoid
        Set of the first state.
    n_runs : int
        Number of runs.
    rule : {'optimal', 'tightened', 'lemma'}
        ``optimal`` gives the least trace for the strip of a reading. ``tightened`` first narrows the strip to the part
        that touches the ellipsoid, which usually gives the smallest set: in the plane on average 2 % above the true
        minimum. ``lemma`` is the simplified step of the source paper.
    reinflation : array_like, shape (n, n), optional
        Shape of an ellipsoid that is added to the set if a reading contradicts it; by default none.

    Attributes
    ----------
    centres : ndarray, shape (n_runs, n)
        Centres of the current sets.
    shapes : ndarray, shape (n_runs, n, n)
        Shapes of the current sets.
    bounds : ndarray, shape (n_runs, m)
        Bounds of the readings' errors in force.
    resets : ndarray of int, shape (n_runs,)
        Number of contradictions so far.

    Raises
    ------
    ValueError
        The sizes do not match, the reinflation is not positive semidefinite, or there is no such rule.

    Examples
    --------
    >>> import numpy as np
    >>> import adcs
    >>> system = adcs.BoundedSystem(np.eye(1), 0.01 * np.eye(1), np.eye(1), np.array([0.1]))
    >>> observer = adcs.EllipsoidObserver(system, adcs.Ellipsoid(np.zeros(1), np.eye(1)))
    >>> observer.predict()
    >>> observer.correct([[0.5]])
    >>> observer.centres.round(1)
    array([[0.5]])
    """

    def __init__(
        self,
        system: BoundedSystem,
        start: Ellipsoid,
        n_runs: int = 1,
        *,
        rule: StepRule = "optimal",
        reinflation: ArrayLike | None = None,
    ) -> None:
        if start.n != system.n:
            raise ValueError(f"Input start must have {system.n} dimensions; instead received {start.n}.")
        if rule not in STEP_RULES:
            raise ValueError(f"Input rule must be one of {', '.join(STEP_RULES)}; instead received {rule!r}.")
        self.system, self.rule = system, rule
        added = np.zeros((system.n, system.n)) if reinflation is None else reinflation
        self._reinflation = shape_matrix(added, system.n, "reinflation")
        self.centres = np.tile(start.centre, (n_runs, 1))
        self.shapes = np.tile(start.shape, (n_runs, 1, 1))
        self.bounds = np.tile(system.bounds, (n_runs, 1))
        self.resets: IntArray = np.zeros(n_runs, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.centres)

    def predict(self, known_inputs: ArrayLike = 0.0) -> None:
        """Advance all sets by one step.

        Parameters
        ----------
        known_inputs : array_like, shape (n_runs, n) or (n,)
            Known change of the state in the step, of each run or of all.
        """
        inputs = np.broadcast_to(np.asarray(known_inputs, dtype=np.float64), self.centres.shape)
        self._run("ellipsoids_predict", inputs=np.ascontiguousarray(inputs), readings=None)

    def correct(self, readings: ArrayLike) -> None:
        """Correct all sets by the readings of one instant.

        Parameters
        ----------
        readings : array_like, shape (n_runs, m)
            Readings of the channels, NaN where missing.

        Raises
        ------
        ValueError
            The shape does not match, or a reading is infinite.
        """
        shape = (len(self), self.system.m)
        values = np.asarray(readings, dtype=np.float64)
        if values.shape != shape or np.isinf(values).any():
            raise ValueError(
                f"Input readings must have shape {shape} and be finite or NaN; instead received shape {values.shape}."
            )
        self._run("ellipsoids_correct", inputs=None, readings=np.ascontiguousarray(values))

    def _run(self, kernel: str, inputs: FloatArray | None, readings: FloatArray | None) -> None:
        work = core.problem(
            "ellipsoids",
            n_states=self.system.n,
            n_channels=self.system.m,
            A=self.system.A,
            disturbance=self.system.disturbance,
            inputs=inputs,
            directions=self.system.directions,
            readings=readings,
            rule=STEP_RULES.index(self.rule),
            inflation=INFLATION,
            reinflation=self._reinflation,
            centres=self.centres,
            shapes=self.shapes,
            bounds=self.bounds,
            resets=self.resets,
        )
        # A step of a run takes a microsecond; starting threads takes hundreds.
        core.run(kernel, work, len(self), block=_RUNS_A_BLOCK)
