"""Cramér-Rao bounds of a dipole's position and moment from one set of readings.

The information on (p, m) is :math:`I = H^T C^{-1} H` with the Jacobian H of the readings and the covariance C of all
other contributions. A nuisance x that enters the readings as N x, with a Gaussian prior of covariance Λ, adds
:math:`N Λ N^T` to C. docs/theory/cramer-rao-bounds.md lists the nuisances and the cases of infinite bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.errors import _vectors
from arrays.io.results import Drawn
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields.multipole import assumed_body_lengths, check_body_length
from magloc.localization.model_errors import body_errors
from magloc.measurement.differences import channel_jacobian, predicted_channels
from magloc.measurement.known_moment import KnownMoment
from magloc.measurement.pose import pose_errors_at_rest
from magloc.measurement.rows import ambient_fields, check_magnitudes, whitenings_of
from magloc.measurement.whitened import WhitenedModel

LOST = 1e-6
"""Relative singular value below which a combination of parameters is not estimable."""


@dataclass(frozen=True, eq=False)
class Bounds(Drawn):
    """Least standard deviations of unbiased estimates from one set of readings.

    Leading axes are batches.

    Attributes
    ----------
    position_m, moment_Am2 : ndarray, shape (..., 3)
        Position and moment of the source in the array's frame.
    range_m : ndarray, shape (...)
        Distance of the source from the sensors' centroid.
    covariance : ndarray, shape (..., 6, 6)
        Covariance of (p, m) [m, A·m²]. Parameters that are not estimable have an infinite variance and NaN covariances.
    sigma_range_m : ndarray, shape (...)
        σ along the line from the centroid to the source.
    sigma_bearing_rad : ndarray, shape (...)
        σ of the direction of that line: root of the sum of the variances of its two angles, taken about any two axes at
        right angles to each other and to the line. So ``σ_position² = σ_range² + (range · σ_bearing)²``.
    sigma_position_m, sigma_moment_Am2 : ndarray, shape (...)
        Roots of the sum of the variances of the three components.
    rank : ndarray of int, shape (...)
        Number of independent estimable combinations of the six parameters.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> places = [[4.0, 0.0, 0.5], [6.0, 0.0, 0.5]]
    >>> array = arrays.tetrahedron(1.5)
    >>> bounds = magloc.cramer_rao_bounds(array, places, [0.0, 0.0, 100.0])
    >>> bounds.sigma_position_m.round(2), bounds.covariance.shape
    (array([0.08, 0.89]), (2, 6, 6))
    """

    figure = "magloc.plots.bounds:bounds_figure"

    position_m: FloatArray
    moment_Am2: FloatArray
    range_m: FloatArray
    covariance: FloatArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    sigma_position_m: FloatArray
    sigma_moment_Am2: FloatArray
    rank: IntArray

    @property
    def is_regular(self) -> BoolArray:
        """Sources whose six parameters are all estimable, shape (...)."""
        return self.rank == 6

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of every component of (p, m), shape (..., 6) [m, A·m²]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def nuisance_free_jacobian(
    array: SensorArray,
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    *,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: ArrayLike | None = 0.0,
) -> FloatArray:
    """Return the whitened Jacobian W (..., C, 6), with all nuisances projected out.

    The information is ``Wᵀ W``.

    A known modulus of the moment adds one row.

    Columns (p, m) in 1/m and 1/(A·m²); NaN for a source on a sensor. For the parameters see :func:`cramer_rao_bounds`.
    """
    p, m = _sources(position_m, moment_Am2)
    check_uncertainty(ambient_uncertainty_T, known_moment_sigma_Am2)
    check_body_length(body_length_m)
    length_m = assumed_body_lengths(array.positions, p, array.circumradius, body_length_m)
    shape = np.broadcast_shapes(p.shape[:-1], length_m.shape)
    p, m = (np.broadcast_to(of, (*shape, 3)).reshape(-1, 3) for of in (p, m))
    length_m = np.broadcast_to(length_m, shape).reshape(-1)
    jacobian = channel_jacobian(array, p, m)
    known: BoolArray = np.all(np.isfinite(jacobian), axis=(-2, -1))
    W = np.full((len(p), array.n_channels + (known_moment_sigma_Am2 < np.inf), 6), np.nan)
    if known.any():
        p, m, jacobian = p[known], m[known], jacobian[known]
        readings = predicted_channels(array, p, m) + array.channel_offset_T
        whitening = whitenings_of(array, np.ones(array.n_channels, np.bool_), readings)
        model = WhitenedModel.of(array, whitening, ambient_fields(array, len(p), None))
        q = model.homogeneous(p)[:, None]
        mu = model.scaled_moment(q, m[:, None])
        ambient_T = ambient_uncertainty_T or array.row_ambient_uncertainty_T
        errors = []
        if ambient_T:
            errors.append(ambient_T * model.linear_gain(model.source_fields(q, mu)))
        if length_m.any():
            errors.append(body_errors(model, q, mu, length_m[known, None]))
        if array.pose is not None:
            errors.append(whitening.root @ pose_errors_at_rest(array, array.pose, p, m))
        if errors:
            model = model.marginalise(np.concatenate(errors, axis=-1))
        W[known, : array.n_channels] = model.whiten(whitening.root @ jacobian)
        if known_moment_sigma_Am2 < np.inf:
            W[known, -1, :3] = 0.0
            W[known, -1, 3:] = KnownMoment((1.0,), known_moment_sigma_Am2).jacobian(m[:, None])[:, 0, 0]
    return W.reshape(*shape, -1, 6)


def cramer_rao_bounds(
    array: SensorArray,
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    *,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: ArrayLike | None = 0.0,
) -> Bounds:
    """Return the Cramér-Rao bounds of a source, or of many over leading axes.

    Parameters
    ----------
    array : SensorArray
        Array with its noise and uncertainties. With an uncertain pose the bounds are for a source in the world,
        in the axes of the stated pose. The array does not move, so clock errors have no effect.
    position_m, moment_Am2 : array_like, shape (..., 3)
        Position [m] and moment [A·m²] of the source in the array's frame.
    ambient_uncertainty_T : float
        Standard deviation per axis of the error of ``array.ambient_T``, the same for all sensors [T]. It replaces
        that of the array.
    known_moment_sigma_Am2 : float
        Standard deviation of a known modulus of the moment [A·m²]; unknown by default.
    body_length_m : array_like, shape (...), optional
        Lengths of the sources; the deviation of their field from a dipole counts as noise. 0 for points; None for a
        quarter of the distance near the array, as in :func:`magloc.locate`.

    Returns
    -------
    Bounds
        All NaN for a source on a sensor; range and bearing NaN for one in the centroid, which has no direction.

    Raises
    ------
    ValueError
        A shape is wrong, or an uncertainty is out of range.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array = arrays.tetrahedron(1.5)
    >>> bounds = magloc.cramer_rao_bounds(array, [5.0, 0.0, 0.5], [0.0, 0.0, 100.0])
    >>> round(float(bounds.sigma_position_m), 2)
    0.3
    """
    check_magnitudes(array)
    p, m = _sources(position_m, moment_Am2)
    W = nuisance_free_jacobian(
        array,
        p,
        m,
        ambient_uncertainty_T=ambient_uncertainty_T,
        known_moment_sigma_Am2=known_moment_sigma_Am2,
        body_length_m=body_length_m,
    )
    line = p - array.centroid
    distance = np.linalg.norm(line, axis=-1)
    known: BoolArray = np.all(np.isfinite(W), axis=(-2, -1))
    # These units make the singular values comparable.
    size = np.linalg.norm(m, axis=-1)
    unit = np.concatenate(
        [
            np.repeat(np.maximum(distance, array.circumradius)[..., None], 3, axis=-1),
            np.repeat(np.where(size > 0.0, size, 1.0)[..., None], 3, axis=-1),
        ],
        axis=-1,
    )
    scaled = np.where(known[..., None, None], W * unit[..., None, :], 0.0)
    missing = max(0, 6 - scaled.shape[-2])
    scaled = np.concatenate([scaled, np.zeros((*scaled.shape[:-2], missing, 6))], axis=-2)
    _, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    lost = s <= LOST * s[..., :1]
    inverse = np.where(lost, 0.0, 1.0 / np.where(lost, 1.0, s))
    V = Vt.mT * unit[..., None]  # columns are the combinations, in the units of (p, m)

    root = V * inverse[..., None, :]
    covariance = root @ root.mT
    hidden: BoolArray = np.greater(_sum_of_squares(Vt.mT, lost), LOST**2)
    covariance = np.where(hidden[..., :, None] | hidden[..., None, :], np.nan, covariance)
    diagonal = np.arange(6)
    covariance[..., diagonal, diagonal] = np.where(hidden, np.inf, covariance[..., diagonal, diagonal])

    with np.errstate(invalid="ignore", divide="ignore"):
        n = line / distance[..., None]
    along = (n[..., None, :] @ Vt.mT[..., :3, :])[..., 0, :]
    across = Vt.mT[..., :3, :] - n[..., :, None] * along[..., None, :]
    place_unit, moment_unit = unit[..., 0], unit[..., 3]
    sigma_range = place_unit * _root_of_sum(along[..., None, :], inverse, lost)
    sigma_across = place_unit * _root_of_sum(across, inverse, lost)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma_bearing = sigma_across / distance
    blank = np.where(known, 0.0, np.nan)
    return Bounds(
        position_m=p,
        moment_Am2=m,
        range_m=distance,
        covariance=covariance + blank[..., None, None],
        sigma_range_m=sigma_range + blank,
        sigma_bearing_rad=sigma_bearing + blank,
        sigma_position_m=place_unit * _root_of_sum(Vt.mT[..., :3, :], inverse, lost) + blank,
        sigma_moment_Am2=moment_unit * _root_of_sum(Vt.mT[..., 3:, :], inverse, lost) + blank,
        rank=np.where(known, (~lost).sum(axis=-1), 0),
    )


def _sum_of_squares(rows: FloatArray, which: BoolArray) -> FloatArray:
    """Return sums of squares (..., r) over the selected entries (..., n) of (..., r, n)."""
    return np.sum(np.where(which[..., None, :], rows, 0.0) ** 2, axis=-1)


def _root_of_sum(rows: FloatArray, inverse: FloatArray, lost: BoolArray) -> FloatArray:
    """Return σ of quantities from their parts (..., r, n) in the singular vectors.

    It is infinite if a part is in a lost one.
    """
    sigma = np.sqrt(np.sum((rows * inverse[..., None, :]) ** 2, axis=(-2, -1)))
    hidden = np.sum(_sum_of_squares(rows, lost), axis=-1) > LOST**2
    return np.where(hidden, np.inf, sigma)


def _sources(position_m: ArrayLike, moment_Am2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    p, m = np.broadcast_arrays(_vectors("position_m", position_m), _vectors("moment_Am2", moment_Am2))
    return p, m


def check_uncertainty(ambient_uncertainty_T: float, known_moment_sigma_Am2: float = np.inf) -> None:
    """Raise ValueError for invalid uncertainties of ambient field or moment."""
    if not 0.0 <= ambient_uncertainty_T < np.inf:
        raise ValueError(
            f"Input ambient_uncertainty_T must be finite and not negative; instead received {ambient_uncertainty_T}."
        )
    if not known_moment_sigma_Am2 > 0.0:
        raise ValueError(f"Input known_moment_sigma_Am2 must be positive; instead received {known_moment_sigma_Am2}.")
