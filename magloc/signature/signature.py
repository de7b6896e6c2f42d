r"""Signature of a ship: permanent, induced and eddy-current moment, from several headings.

In the axes of the body (forward, left, up) the moment is

.. math:: R^T m = m_p + α B_b - β \dot B_b, \qquad B_b = R^T B_a

with the ambient field B_a. The moment is linear in m_p, α and β, which form a constant parameter vector θ;
:mod:`magloc.signature.moment_filter` estimates it over all rows of all passes. Combinations that the headings do not
determine keep their prior uncertainty: on a level keel the readings contain only the sum of the vertical permanent and
the vertical induced moment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.errors import InputError
from arrays.io.results import Result
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.localization.fit.results import is_misfit
from magloc.measurement.plausibility import usable_readings, warn_of_moments
from magloc.readings import Readings, as_readings
from magloc.signature.files import lines_of_signature
from magloc.signature.moment_filter import Basis, relinearise
from magloc.signature.moment_track import EXACT, goodness_of_fit, moment_model, rows_on_path, turning_basis
from magloc.signature.path import ObjectPath, PathError

Induced = Literal["none", "diagonal", "symmetric"]
AXES = {"none": (), "diagonal": ("xx", "yy", "zz"), "symmetric": ("xx", "yy", "zz", "yz", "xz", "xy")}
"""Components of α that are estimated."""
MU0 = 4.0 * math.pi * dipole.MU0_OVER_4PI
LEAST_KNOWN = 0.5
"""Share of the object's moment above which the σ of a combination of parameters means "not determined"."""
# Share of the largest component of a combination below which a parameter is not named.
_NAMED = 0.1
# Smallest divisor instead of the rate of an ambient field that does not change [T/s].
_NO_RATE = 1e-9


@dataclass(frozen=True, eq=False)
class Components:
    """Parts of the moment, and the units of its parameters.

    Attributes
    ----------
    induced : {"none", "diagonal", "symmetric"}
    eddy : bool
    ambient_T, rate_T_s : float
        Modulus of the ambient field and its largest rate in the body. They scale the parameters to A·m².
    """

    induced: Induced
    eddy: bool
    ambient_T: float
    rate_T_s: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        eddies = ("eddy xx", "eddy yy", "eddy zz") if self.eddy else ()
        return ("permanent x", "permanent y", "permanent z", *(f"induced {a}" for a in AXES[self.induced]), *eddies)

    def moment_matrix(self, R: FloatArray, field_T: FloatArray, rate_T_s: FloatArray) -> FloatArray:
        """Return the moment per parameter (n, 3, q) in the frame of the results.

        R (n, 3, 3): from the body to that frame; field and its rate (n, 3) in the body's axes.
        """
        columns = [np.broadcast_to(np.eye(3), R.shape), self._induced_moment(field_T)]
        if self.eddy:
            columns.append(-rate_T_s[:, :, None] * np.eye(3) / self.rate_T_s)
        return R @ np.concatenate(columns, axis=2)

    def basis(self, R: FloatArray, field_T: FloatArray, rate_T_s: FloatArray) -> Basis:
        """Return the moment matrix and its change by a turn of the object.

        A turn of the object turns the ambient field the other way in the body.
        """
        turning = turning_basis(self.moment_matrix(R, field_T, rate_T_s))
        axes = np.swapaxes(R, 1, 2)  # axes of the frame in the body, as columns
        for k in range(3):
            turned = -np.cross(axes[:, :, k], field_T)
            turning.by_turn[:, k, :, self.induced_columns] += R @ self._induced_moment(turned)
        return turning

    @property
    def induced_columns(self) -> slice:
        """Slice of the induced parameters."""
        return slice(3, 3 + len(AXES[self.induced]))

    def _induced_moment(self, field_T: FloatArray) -> FloatArray:
        """Return the induced moment per parameter (n, 3, a) in the body's axes."""
        matrix = np.zeros((len(field_T), 3, len(AXES[self.induced])))
        for column, (i, j) in enumerate(_indices(self.induced)):
            matrix[:, i, column] = field_T[:, j]
            matrix[:, j, column] = field_T[:, i]
        return matrix / self.ambient_T


def _indices(induced: Induced) -> list[tuple[int, int]]:
    """Return row and column in α of every component that is estimated."""
    return [("xyz".index(axes[0]), "xyz".index(axes[1])) for axes in AXES[induced]]


@dataclass(frozen=True, eq=False, repr=False)
class Signature(Result):
    """Permanent, induced and eddy-current moment of an object, with their uncertainty.

    Attributes
    ----------
    components : Components
        Parts of the moment.
    parameters_Am2 : ndarray, shape (q,)
        Parameters. Combinations that are not determined are as near to zero as the others allow.
    covariance : ndarray, shape (q, q)
        Covariance of the parameters [(A·m²)²].
    ambient_T : ndarray, shape (3,)
        Mean ambient field [T], in the frame of the results.
    moment_rms_Am2 : float
        Root of the mean square of the moment over the rows.
    rows : int
        Rows that were used.
    chi2 : float
        χ² of the residuals.
    dof : int
        Its degrees of freedom.
    undetermined : tuple of str
        Names of parameters, or combinations of them, that the headings do not determine.

    Examples
    --------
    >>> import magloc
    >>> ship = magloc.datasets.load("ship")
    >>> path = magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
    >>> signature = magloc.fit_signature(ship.array, ship.readings, path)
    >>> signature.undetermined
    ('permanent z against induced zz',)
    """

    figure = "magloc.plots.signatures:signature_figure"
    command = "signature"
    dimension = "parameter"
    frame = "forward, left, up"

    components: Components
    parameters_Am2: FloatArray
    covariance: FloatArray
    ambient_T: FloatArray
    moment_rms_Am2: float
    rows: int
    chi2: float
    dof: int
    undetermined: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: part and axes of the body, x forward, y left, z up."""
        return self.components.names

    @property
    def sigma_Am2(self) -> FloatArray:
        """Standard deviations (q,) [A·m²]."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def determined(self) -> FloatArray:
        """Parameters (q,) [A·m²], NaN where they are not known."""
        return np.where(self.sigma_Am2 > LEAST_KNOWN * self.moment_rms_Am2, np.nan, self.parameters_Am2)

    @property
    def permanent_Am2(self) -> FloatArray:
        """Permanent moment (3,) in the body's axes [A·m²], NaN where it is not determined."""
        return self.determined[:3]

    @property
    def polarisability_m3(self) -> FloatArray:
        """Induced moment per ambient field, times µ0 (3, 3) [m³].

        In the body's axes; NaN where it is not determined.
        """
        alpha = np.zeros((3, 3))
        values = self.determined[self.components.induced_columns]
        for (i, j), value in zip(_indices(self.components.induced), values, strict=True):
            alpha[i, j] = alpha[j, i] = MU0 * value / self.components.ambient_T
        return alpha

    @property
    def eddy_m3_s(self) -> FloatArray:
        """Eddy-current moment per rate of the ambient field, times -µ0 (3,) [m³·s].

        In the body's axes.
        """
        own = self.determined[-3:] if self.components.eddy else np.zeros(3)
        return MU0 * own / self.components.rate_T_s

    @property
    def misfit(self) -> bool:
        """True if χ² is so large that noise explains it once in a million (no such moment)."""
        return bool(is_misfit(self.chi2, self.dof))

    def moment(self, heading_deg: ArrayLike, ambient_T: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the moment on a level keel and a steady course, and its covariance.

        Parameters
        ----------
        heading_deg : array_like, shape (...)
            Heading, clockwise from the y axis of the frame, which is north if the frame is east, north, up.
        ambient_T : array_like, shape (3,), optional
            Ambient field in the frame of the results [T]; by default that of the passes.

        Returns
        -------
        moment_Am2 : ndarray, shape (..., 3)
            Moment in the frame of the results [A·m²].
        covariance : ndarray, shape (..., 3, 3)
            Its covariance [(A·m²)²].
        """
        M = self._level_basis(heading_deg, ambient_T)
        return M @ self.parameters_Am2, M @ self.covariance @ np.swapaxes(M, -1, -2)

    def field(
        self, offset_m: ArrayLike, heading_deg: ArrayLike = 0.0, ambient_T: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the field on a level keel and a steady course, and its covariance.

        The model is a dipole, which is wrong nearer than about three lengths of the body.

        Parameters
        ----------
        offset_m : array_like, shape (..., 3)
            Offset from the object to the point of the field, along its axes forward, left, up [m].
        heading_deg : array_like, shape (...)
            As in :meth:`moment`.
        ambient_T : array_like, shape (3,), optional
            As in :meth:`moment`.

        Returns
        -------
        field_T : ndarray, shape (..., 3)
            Field in the frame of the results [T].
        covariance : ndarray, shape (..., 3, 3)
            Its covariance [T²].
        """
        offset = _level_rotation(heading_deg) @ np.asarray(offset_m, dtype=np.float64)[..., None]
        M = self._level_basis(heading_deg, ambient_T)
        J = dipole.field_matrix(offset[..., 0], np.zeros(3)) @ M
        return J @ self.parameters_Am2, J @ self.covariance @ np.swapaxes(J, -1, -2)

    def _level_basis(self, heading_deg: ArrayLike, ambient_T: ArrayLike | None) -> FloatArray:
        R = _level_rotation(heading_deg)
        ambient = self.ambient_T if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)
        flat = R.reshape(-1, 3, 3)
        field_body = np.swapaxes(flat, 1, 2) @ ambient
        M = self.components.moment_matrix(flat, field_body, np.zeros_like(field_body))
        return M.reshape(*R.shape[:-1], -1)

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, which is never long."""
        return lines_of_signature(self)

    def columns(self) -> dict[str, Column]:
        """Return the parameters and their standard deviations, NaN where they are not determined."""
        return {"part": list(self.names), "moment_Am2": self.determined, "sigma_Am2": self.sigma_Am2}


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def fit_signature(
    array: SensorArray,
    readings: Readings | Sequence[Readings],
    path: ObjectPath | Sequence[ObjectPath],
    *,
    induced: Induced = "diagonal",
    eddy: bool = False,
    path_error: PathError = EXACT,
    ambient_T: ArrayLike | None = None,
) -> Signature:
    r"""Fit permanent and induced moment of an object that passes an array on known courses.

    .. math:: m = R (m_p + α R^T B_a - β \frac{d}{dt} R^T B_a)

    Parameters
    ----------
    array : SensorArray
        Three independent differences are enough. Correlated errors that it states are estimated too.
    readings : Readings, or a sequence of them
        Readings of every pass, with one clock, in the order of time. Saturated readings are not used.
    path : ObjectPath, or a sequence of them
        Path of every pass, or one for all. Without an attitude the object is level, its bow along the course.
    induced : {"diagonal", "symmetric", "none"}
        Components of α that are estimated.
    eddy : bool
        Estimate the diagonal β. It needs passes on which the object turns.
    path_error : PathError
        Uncertainty of the path of every pass; exact by default. Attitudes count as exact.
    ambient_T : array_like, shape (3,), optional
        Ambient field in the frame of the results [T], if the readings and the array do not have it.

    Returns
    -------
    Signature
        Moments in the axes of the object, with covariance, χ² and combinations that the passes do not
        determine.

    Raises
    ------
    InputError
        The ambient field is not known, or a path has none of the times of its readings.
    ValueError
        Time does not increase from row to row, or there are not as many paths as passes.

    Examples
    --------
    >>> import magloc
    >>> ship = magloc.datasets.load("ship")
    >>> path = magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
    >>> signature = magloc.fit_signature(ship.array, ship.readings, path)
    >>> field_T, covariance = signature.field([0.0, 0.0, -9.0], heading_deg=80.0)
    >>> bool(1e9 * abs(field_T[2]) > 1000.0)
    True
    """
    passes = [readings] if isinstance(readings, Readings) else [as_readings(part) for part in readings]
    paths = [path] * len(passes) if isinstance(path, ObjectPath) else list(path)
    if len(paths) != len(passes) or not passes:
        raise ValueError(f"Input path must be one, or one for each of {len(passes)} passes; instead: {len(paths)}.")
    if len({part.array_position_m is None for part in passes}) > 1:
        raise ValueError("Input readings must all have the array's pose, or none; instead some have it.")
    used, positions, rotations, fields, rates, distances = [], [], [], [], [], []
    for measured, of_part in zip(passes, paths, strict=True):
        part = usable_readings(array, measured)
        position, rotation, rows = rows_on_path(part, of_part.along_course())
        if rotation is None:
            raise ValueError("Input path must have an attitude; instead it has none.")  # along_course gives one
        field = np.einsum("nij,ni->nj", rotation, _ambient(array, rows, ambient_T, needed=induced != "none" or eddy))
        used.append(rows)
        positions.append(position[:, None])
        origin = 0.0 if rows.array_position_m is None else rows.array_position_m
        distances.append(np.linalg.norm(position - origin - array.centroid, axis=1))
        rotations.append(rotation)
        fields.append(field)
        rates.append(np.gradient(field, rows.time_s, axis=0) if len(rows) > 1 else np.zeros_like(field))
    R, field, rate = np.concatenate(rotations), np.concatenate(fields), np.concatenate(rates)
    modulus = float(np.linalg.norm(field, axis=1).mean()) or 1.0
    components = Components(induced, eddy, modulus, max(_NO_RATE, float(np.linalg.norm(rate, axis=1).max())))
    model = moment_model(array, used, positions, components.basis(R, field, rate), path_error, 0.0)
    steps = relinearise(model, gate=False)
    theta, root = steps[-1].x[model.moment], steps[-1].S[model.moment]
    moment_rms = math.sqrt(float(np.mean(np.sum((model.basis.M @ theta) ** 2, axis=1))))
    warn_of_moments([np.concatenate(distances).min()], [[moment_rms, 0.0, 0.0]])
    open_ = _undetermined_combinations(components.names, root, LEAST_KNOWN * moment_rms)
    chi2, dof = goodness_of_fit(model, steps)
    return Signature(
        components,
        theta,
        root @ root.T,
        np.einsum("nij,nj->ni", R, field).mean(axis=0),
        moment_rms,
        len(model.rows),
        chi2,
        dof + len(open_),  # combinations that are not determined use no degree of freedom
        open_,
    )


def _undetermined_combinations(names: Sequence[str], root: FloatArray, limit: float) -> tuple[str, ...]:
    """Return the names of combinations of parameters whose σ is beyond a limit.

    ``root`` is the square root (q, n) of the parameters' covariance.
    """
    vectors, sigma, _ = np.linalg.svd(root, full_matrices=False)
    words = []
    for direction in _row_echelon(vectors[:, sigma > limit].T):
        share = np.abs(direction) / np.abs(direction).max()
        words.append(" against ".join(name for name, part in zip(names, share, strict=True) if part > _NAMED))
    return tuple(words)


def _ambient(array: SensorArray, readings: Readings, ambient_T: ArrayLike | None, *, needed: bool) -> FloatArray:
    """Return the ambient field (n, 3) in the frame of the results."""
    n = len(readings)
    if ambient_T is not None:
        return np.broadcast_to(np.asarray(ambient_T, dtype=np.float64), (n, 3))
    of_rows = readings.ambient_T
    if of_rows is None and array.ambient_T is not None:
        of_rows = np.broadcast_to(np.asarray(array.ambient_T), (n, 3))
    if of_rows is None:
        if needed:
            raise InputError("Input ambient_T: found no ambient field, expected one for the induced moment.")
        return np.zeros((n, 3))
    return of_rows if readings.array_rotation is None else readings.array_rotation.apply(of_rows)


def _level_rotation(heading_deg: ArrayLike) -> FloatArray:
    """Return rotations (..., 3, 3) from forward, left, up to the frame, on a level keel."""
    yaw = np.radians(90.0 - np.asarray(heading_deg, dtype=np.float64))
    sine, cosine, zero, one = np.sin(yaw), np.cos(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _row_echelon(directions: FloatArray) -> FloatArray:
    """Return directions (d, q) of the same span with as many zeros as possible.

    This is the reduced row echelon form.
    """
    rows = directions.copy()
    for k in range(len(rows)):
        i, j = np.unravel_index(int(np.argmax(np.abs(rows[k:]))), rows[k:].shape)
        rows[[k, k + int(i)]] = rows[[k + int(i), k]]
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, j][:, None] * rows[k]
    return rows
