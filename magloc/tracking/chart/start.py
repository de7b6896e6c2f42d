"""Start of a track: a mixture over all directions and ranges that the first row allows.

The prior is a grid of cells, uniform in direction and in the logarithm of the range. Each is a Gaussian in the chart
about its centre with a nearly unknown moment, and their sum is nearly constant. The filter updates them by the row. The
cells used are those that explain the row nearly as well as the best one, those that explain it better than their
neighbours, and the optima that :class:`magloc.localization.locator.Locator` finds between them.

If a row determines a component better than its cell does, the cell's Gaussian would bias the component and its weight.
Then the cell is centred again at the component, and equal components of several cells count once. A component along a
curved valley of ranges is divided along the range by halving the pitch of the grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.directions import sphere_directions
from magloc.levels import CONTRADICTION, CREDIBLE_ROW
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.locator import Locator
from magloc.measurement.magnet import magnet_of
from magloc.measurement.nuisances import SensorErrors
from magloc.measurement.rows import check_magnitudes, check_spans
from magloc.tracking import row_filter
from magloc.tracking.chart.known_moment import UNIFORM_IN_SPACE, KnownInWorld
from magloc.tracking.chart.mixture import DROPPED_BELOW, FARTHEST, NEAREST, Mixture
from magloc.tracking.chart.stack import RowOrStack, Stack
from magloc.tracking.chart.update import StateUpdates, is_regular, update_states
from magloc.tracking.coordinates import MOMENT_POWER, Chart, mirror_images, source_root
from magloc.tracking.measurement import RowMeasurement, whitening, zero_if_nan
from magloc.tracking.motion import N_SOURCE, MotionModel
from magloc.tracking.row_filter import LARGEST_BEND, Gaussians, RowUpdates
from magloc.tracking.rows import Row

OF_PITCH = 0.6
"""Standard deviation of a cell over the grid's pitch, with which neighbours sum to a nearly constant density."""
_N_DIRECTIONS, _N_RANGES = 100, 14
_PITCH = math.log(FARTHEST / NEAREST) / (_N_RANGES - 1)
_SPACING = math.sqrt(4.0 * math.pi / _N_DIRECTIONS)
# Largest excess of χ² over the best cell for a cell to be used; cells with more are used only if they are local peaks.
_WITHIN = 20.0
_NEIGHBOURS = 1.6 * _SPACING
# Prior σ of the moment over the best moment at a cell's centre.
_UNKNOWN_MOMENT = 10.0
# Share of a cell's σ below which the row determines a component.
_NARROW = 0.5
# Logarithm of the density of all cells over that of one at its centre, along one coordinate.
_EVEN = math.log(OF_PITCH * math.sqrt(2.0 * math.pi))
_CELL = OF_PITCH * np.array([_PITCH, _SPACING, _SPACING])
_MOST_BENT = 100.0
# Extent of the components along a valley, in standard deviations of its log-range.
_VALLEY = 4.0
_SIGMA_PRIOR = (math.log(FARTHEST / NEAREST) / math.sqrt(12.0), 1.0, 1.0)
NOT_ALLOWED = "not acquired: no source of the stated region and moment explains the readings"
NO_AMBIENT = "not acquired: without an ambient field fewer than six differences of moduli do not start a track"
NO_DIPOLE = "not acquired: no dipole fits the readings"


def prior_root(chart: Chart) -> FloatArray:
    r"""Return the Cartesian root (6, 6) of the prior covariance of a source at x (n,).

    It is a Gaussian with the information of the start's prior: log-range and direction uniform, and the density
    :math:`\propto |\mu|^{-3}` of the scaled moment, whose mean information along an axis is :math:`1 / |\mu|^2`.
    """
    strength = float(np.linalg.norm(chart.x[3:6])) / float(chart.length) ** MOMENT_POWER
    return source_root(chart, np.array([*_SIGMA_PRIOR, *[strength] * 3]))


def first_root(chart: Chart, motion: MotionModel, sigma_range: FloatArray | None = None) -> FloatArray:
    """Return Cartesian roots (K, n, n) of nearly flat priors about states x (K, n).

    `sigma_range` (K,) are standard deviations of the log-ranges, by default those of the whole search.
    """
    sigma = np.tile(_SIGMA_PRIOR, (len(chart.x), 1))
    if sigma_range is not None:
        sigma[:, 0] = sigma_range
    return _with_motion(chart, motion, sigma)


def _with_motion(chart: Chart, motion: MotionModel, sigma: FloatArray) -> FloatArray:
    """Return Cartesian roots (K, n, n) from σ (K, 3) of log-range and direction."""
    strength = np.linalg.norm(chart.x[:, 3:6], axis=1) / chart.length**MOMENT_POWER
    _, rest = motion.start(np.zeros(N_SOURCE), np.zeros((N_SOURCE, N_SOURCE)))
    root = np.tile(np.eye(chart.x.shape[1]), (len(chart.x), 1, 1))  # of the pose's errors, behind the motion
    root[:, : len(rest), : len(rest)] = rest
    of_moment = _UNKNOWN_MOMENT * np.tile(strength[:, None], 3)
    root[:, :N_SOURCE, :N_SOURCE] = source_root(chart, np.concatenate([sigma, of_moment], axis=1))
    return root


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells in the array's frame: positions (n, 3), and pairs of directions that are neighbours."""

    position_m: FloatArray
    neighbours: BoolArray

    @classmethod
    def of(cls, array: SensorArray) -> _Grid:
        directions = sphere_directions(_N_DIRECTIONS)
        ranges = array.circumradius * np.geomspace(NEAREST, FARTHEST, _N_RANGES)
        position = array.centroid + ranges[:, None, None] * directions
        return cls(position.reshape(-1, 3), np.arccos(np.clip(directions @ directions.T, -1, 1)) < _NEIGHBOURS)

    def select(self, explained: FloatArray) -> BoolArray:
        """Return the cells (n,) to start from, by the energy explained, -inf if not allowed."""
        table = explained.reshape(_N_RANGES, _N_DIRECTIONS)
        around = np.where(self.neighbours, table[:, None, :], -np.inf).max(axis=2)
        padded = np.pad(table, ((1, 1), (0, 0)), constant_values=-np.inf)
        peak = (table >= around) & (table >= padded[:-2]) & (table >= padded[2:])
        return np.asarray((peak | (table > table.max() - _WITHIN)) & np.isfinite(table)).ravel()


@dataclass(frozen=True, eq=False)
class _Seeds:
    """Initial states of components.

    Attributes
    ----------
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Position and moment in the world frame.
    cell : ndarray of int, shape (n, 3)
        Range and direction of the cell on the grid, -1 along coordinates that the row determines, and the number of
        halvings of its pitch.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    cell: IntArray


class TrackStarter:
    """Estimator of a source from the first row, for one array."""

    def __init__(self, array: SensorArray, errors: SensorErrors, prior: SourcePrior) -> None:
        check_magnitudes(array)
        check_spans(array)
        self.errors, self.prior = errors, prior
        self.misfit = np.zeros(0)  # of the last row that no dipole fits
        self._grid = _Grid.of(array)
        self._locator: Locator | None = None
        self._examiner: Locator | None = None
        if decorrelated_differences(array).n_differences >= N_SOURCE:
            magnet = magnet_of(array)
            length_m = 0.0 if magnet is None else None
            self._locator = Locator(array, prior=prior, body_length_m=length_m, magnet=magnet, exclude_faulty=False)
            self._examiner = Locator(array, prior=prior, magnet=magnet)

    def mixture(self, measurement: RowOrStack, motion: MotionModel) -> tuple[Mixture | None, str]:
        """Return the mixture of source and errors of the pose by one row, or None and the reason."""
        if not measurement.is_detected(self.errors.sigma):
            return None, "not acquired: no signal stands out of noise"
        # Source and errors of sensors have no correlation yet, so that the errors are noise.
        alone = measurement.with_errors_as_noise(self.errors.sigma)
        known = KnownInWorld.of(self.prior, measurement.row.R_world_from_array)
        seeds = self._seeds(alone)
        if not len(seeds.cell):
            array = alone.model.array
            is_linear = array.ambient_fields.any() or not array.channel_is_scalar.any()
            return None, NOT_ALLOWED if is_linear or alone.n_differences >= N_SOURCE else NO_AMBIENT
        found = _components(alone, motion, seeds, known)
        for refine in (_recentre, _subdivide_valleys):
            finer = refine(seeds, found, measurement)
            if not len(finer.cell):
                return None, NOT_ALLOWED
            if finer is not seeds:
                seeds, found = finer, _components(alone, motion, finer, known)
        row = measurement.row
        position = (found.x[:, :3] - row.origin_m) @ row.R_world_from_array
        sound = self.prior.allows_position(position) & self.prior.allows_moment(found.x[:, 3:6])
        sound &= np.isfinite(found.log_evidence) & found.converged
        if not sound.any():
            return None, NOT_ALLOWED
        dof = measurement.n_differences - N_SOURCE + (0 if known is None else known.n_known)
        if dof > 0 and found.chi2[sound].min() > chdtri(dof, CONTRADICTION):
            best = int(np.argmin(np.where(sound, found.chi2, np.inf)))
            self.misfit = alone.z - alone.predict_source(found.x[best])
            return None, NO_DIPOLE
        log_weight = found.log_evidence + _EVEN * ((seeds.cell < 0) @ np.array([1.0, 2.0, 0.0]))
        log_weight -= math.log(2.0) * seeds.cell[:, 2]
        if known is not None:
            log_weight += UNIFORM_IN_SPACE * np.log(measurement.chart(found.x).length)
        mixture = _mixture(found, log_weight, measurement)
        return mixture.take(sound).take(unique_components(mixture.take(sound), seeds.cell[sound])), ""

    def faulty_sensors(self, row: Row) -> BoolArray:
        """Return the sensors (N,) that a fix of the row excludes."""
        dropped = () if self._examiner is None else self._examiner.fit(row.readings_T, row.ambient_T).dropped_sensors
        return np.isin(self.errors.array.ids, dropped)

    def _seeds(self, measurement: RowOrStack) -> _Seeds:
        """Return the selected cells and the best fits of the row."""
        cells, row = self._grid.position_m, measurement.row
        world = row.origin_m + cells @ row.R_world_from_array.T
        columns = measurement.moment_columns(world)
        # Moduli without an ambient field are not linear in the moment: their cells explain nothing, only fits remain.
        whiten = measurement.whitening
        columns, left = whiten @ zero_if_nan(columns), whiten @ measurement.without_source
        moments = (np.linalg.pinv(columns, rcond=1e-6) @ left[:, None])[..., 0]
        explained = np.sum((columns @ moments[..., None])[..., 0] ** 2, axis=1)
        explained[~self.prior.allows_position(cells) | ~(explained > 0.0)] = -np.inf
        chosen = np.flatnonzero(self._grid.select(explained))
        position, moment = [world[chosen]], [moments[chosen]]
        cell = [np.stack([*np.divmod(chosen, _N_DIRECTIONS), np.zeros_like(chosen)], axis=1)]
        if self._locator is not None and measurement.z.size >= N_SOURCE:
            R = row.R_world_from_array
            for solution in self._locator.fit(row.readings_T, row.ambient_T).solutions:
                source = np.concatenate([row.origin_m + R @ solution.position_m, R @ solution.moment_Am2])
                position.append(source[:3])
                moment.append(source[3:])
                cell.append(np.array([-1, -1, 0]))
                images, of_range = _images(source, measurement)
                position.append(images[:, :3])
                moment.append(images[:, 3:])
                cell.append(np.stack([of_range, np.full_like(of_range, -1), np.zeros_like(of_range)], axis=1))
        return _Seeds(np.vstack(position), np.vstack(moment), np.vstack(cell))


def _images(source: FloatArray, measurement: RowOrStack) -> tuple[FloatArray, IntArray]:
    """Return mirror images (n, 6) of a source at the nearest ranges (n,) of the grid."""
    images = mirror_images(source[None], measurement.centroid_m)[1:, 0]
    chart = measurement.chart(images)
    below = math.floor(math.log(float(chart.length[0]) / measurement.radius_m / NEAREST) / _PITCH)
    of_range = np.repeat(np.clip([below, below + 1], 0, _N_RANGES - 1), len(images))
    images, length = np.tile(images, (2, 1)), np.tile(chart.length, 2)
    r = measurement.radius_m * NEAREST * np.exp(_PITCH * of_range)
    images[:, :3] = measurement.centroid_m + r[:, None] * np.tile(chart.u, (2, 1))
    images[:, 3:] *= ((r / length) ** MOMENT_POWER)[:, None]
    return images, of_range


def _components(
    measurement: RowOrStack, motion: MotionModel, seeds: _Seeds, known: KnownInWorld | None = None
) -> StateUpdates | RowUpdates:
    """Return the update by a row of the cells about seeds."""
    state, _ = motion.start(np.zeros(N_SOURCE), np.zeros((N_SOURCE, N_SOURCE)))
    x = np.tile(np.append(state, np.zeros(measurement.n_pose)), (len(seeds.cell), 1))
    x[:, :3], x[:, 3:6] = seeds.position_m, seeds.moment_Am2
    chart, sigma = measurement.chart(x), np.tile(_CELL, (len(x), 1))
    sigma[:, 0] /= 2.0 ** seeds.cell[:, 2]
    S = chart.inverse_jacobian() @ _with_motion(chart, motion, sigma)
    if known is not None or isinstance(measurement, Stack):
        return update_states(x, S, measurement, known)
    found = row_filter.update(Gaussians(x, S, n_nuisances=measurement.n_pose), measurement.kernel_rows)
    return replace(found, converged=found.converged & is_regular(found.S))


def _mixture(found: StateUpdates | RowUpdates, log_weight: FloatArray, measurement: RowOrStack) -> Mixture:
    n, centroid_m, radius_m = measurement.n_charted, measurement.centroid_m, measurement.radius_m
    return Mixture(found.x, found.S, log_weight, n, centroid_m, radius_m, measurement.n_pose)


def _recentre(seeds: _Seeds, found: StateUpdates | RowUpdates, measurement: RowOrStack) -> _Seeds:
    """Return seeds at their components, along coordinates that the row determines."""
    sigma = np.sqrt(np.sum(found.S[:, :3] ** 2, axis=2))
    narrow = sigma < _NARROW * _CELL
    narrow = np.stack([narrow[:, 0], narrow[:, 1] & narrow[:, 2]], axis=1)
    if not narrow.any() and (seeds.cell >= 0).all():
        return seeds
    old, new = (Chart.at(x, measurement.centroid_m, measurement.radius_m) for x in (seeds.position_m, found.x[:, :3]))
    seen = found.x[:, 3:6] / new.length[:, None] ** 4
    offset = np.where(narrow[:, 1:], new.u, old.u)
    range_old, range_new = (np.linalg.norm(chart.x[:, :3] - measurement.centroid_m, axis=1) for chart in (old, new))
    r = np.where(narrow[:, 0], range_new, range_old)
    length = np.maximum(r, measurement.radius_m)
    cell = seeds.cell.copy()
    cell[:, :2][narrow] = -1
    # A best fit has no cell, so that it counts only if the row determines it.
    sound = np.isfinite(found.log_evidence) & found.converged & ((seeds.cell[:, :2] >= 0) | narrow).all(axis=1)
    return _Seeds(
        (measurement.centroid_m + r[:, None] * offset)[sound], (seen * length[:, None] ** 4)[sound], cell[sound]
    )


def _subdivide_valleys(seeds: _Seeds, found: StateUpdates | RowUpdates, measurement: RowOrStack) -> _Seeds:
    """Replace seeds in a curved valley of ranges by several along it.

    A precise row leaves a narrow valley, and a Gaussian at its middle does not cover its ends.
    """
    n = measurement.n_charted
    sound = np.isfinite(found.log_evidence) & found.converged
    likely = sound & (found.log_evidence > found.log_evidence[sound].max(initial=-np.inf) + DROPPED_BELOW)
    own = np.flatnonzero(likely & (seeds.cell[:, 0] < 0))
    chart, S = measurement.chart(found.x[own, :n]), found.S[own, :n]
    sigma, log_range = np.linalg.norm(S[:, 0], axis=1), np.log(chart.length / measurement.radius_m)
    along = (S @ S[:, 0, :, None])[..., 0] / sigma[:, None]
    ends = [measurement.predict_source(chart.retract(share * along)) for share in (-1.0, 0.0, 1.0)]
    bend = np.minimum(np.linalg.norm(0.5 * (ends[0] + ends[2]) - ends[1], axis=1), _MOST_BENT)
    bent = np.flatnonzero((bend > LARGEST_BEND) & (log_range > _VALLEY * sigma))
    if not bent.size:
        return seeds
    straight = np.delete(np.arange(len(sound)), own[bent])
    position, moment, cell = [seeds.position_m[straight]], [seeds.moment_Am2[straight]], [seeds.cell[straight]]
    for k in bent.tolist():
        halvings = max(0, math.ceil(math.log2(_CELL[0] / sigma[k] * math.sqrt(bend[k] / LARGEST_BEND))))
        pitch, reach = _PITCH / 2.0**halvings, _VALLEY * sigma[k]
        ranges = np.arange(round((log_range[k] - reach) / pitch), round((log_range[k] + reach) / pitch) + 1)
        every = np.full(len(ranges), k)
        e = ((ranges * pitch - log_range[k]) / sigma[k])[:, None] * along[k]
        state, of_direction = chart.take(every).retract(e), seeds.cell[own[every], 1]
        position.append(state[:, :3])
        moment.append(state[:, 3:6])
        cell.append(np.stack([_N_RANGES + ranges, of_direction, np.full_like(ranges, halvings)], axis=1))
    return _Seeds(np.vstack(position), np.vstack(moment), np.vstack(cell))


def with_errors(mixture: Mixture, measurement: RowMeasurement, sigma: FloatArray) -> Mixture:
    r"""Return the mixture with the sensors' errors, of prior σ (n_errors,), as further states.

    They are estimated from the residual at each component. With the effect :math:`\Phi` of unit errors it is
    :math:`\varepsilon = \sigma \Phi^T (1 + \Phi \Phi^T)^{-1} (z - h(x))`, with the covariance of a linear model.
    """
    if not sigma.size:
        return mixture
    n, chart, unit = measurement.n_charted, mixture.chart, measurement.effect * sigma
    gain = sigma[:, None] * np.linalg.solve(np.eye(len(unit)) + unit @ unit.T, unit).T
    left = measurement.z - measurement.predict_source(mixture.x)
    H = measurement.directional_derivative(mixture.x, chart.jacobian(np.zeros_like(mixture.x)))
    rows = np.zeros((len(mixture), n + sigma.size, n + sigma.size))
    rows[:, :n, :n], rows[:, n:, :n] = mixture.S, -gain @ (H @ mixture.S)
    rows[:, n:, n:] = sigma[:, None] * whitening(unit.T).T
    return replace(mixture, x=np.concatenate([mixture.x, left @ gain.T], axis=1), S=rows)


def unique_components(mixture: Mixture, cell: IntArray | None = None) -> IntArray:
    """Return indices of components, heaviest first, without duplicates of the same cell."""
    source = mixture.source_marginal()
    cell = np.zeros((len(source), 1), dtype=np.intp) if cell is None else cell.reshape(len(source), -1)
    _, share, n_alike = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    share = share.ravel()  # numpy 2.0.0 gives a column
    left = np.argsort(-mixture.log_weight, kind="stable")
    alone = n_alike[share[left]] == 1
    unique, left = left[alone].tolist(), left[~alone]
    limit = chdtri(N_SOURCE, 1.0 - CREDIBLE_ROW)
    while left.size:
        first, others = left[0], left[1:]
        unique.append(first)
        same = others[share[others] == share[first]]
        equal = same[source.take(same).square_distance(source.x[first]) < limit]
        left = others[~np.isin(others, equal)]
    return np.array(sorted(unique, key=lambda k: -mixture.log_weight[k]))
