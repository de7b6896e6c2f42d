"""Beam search for several dipoles, one more source at a time, with random restarts.

All functions work on b sets of readings of one :class:`magloc.measurement.whitened.WhitenedModel` at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.directions import hemisphere
from magloc.localization.fit.gauss_newton import JointFits, fit_moments, refine
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.localization.search.candidates import (
    LastBases,
    SingleArray,
    best_candidates,
    distinct_best,
    linear_scores,
    modulus_scores,
    rows_of_equal_gain,
)
from magloc.localization.search.kernels import search_optima
from magloc.localization.search.known_moment import starts_of_known_moment
from magloc.measurement.channels import signals_of
from magloc.measurement.whitened import WhitenedModel

Allowed = Callable[[FloatArray, FloatArray], NDArray[np.bool_]]
_SAME_RAD = 0.02
_SAME_MOMENT = 0.05
_SAME_CHI2 = 0.01
_N_TEMPLATE_DIRECTIONS = 24
# Rows that are scored by templates at once; each row has many scores.
_ROWS_OF_TEMPLATES = 64
# Starts of a new source for every fit.
_MORE_STARTS = 4
# A restart draws its new source from this many of the best candidates.
_RESTART_CANDIDATES = 16
_MOST_ITERATIONS = 60


def best_distinct(fits: JointFits, n_rows: int, width: int) -> JointFits:
    """Return the `width` best distinct fits of every row.

    Every row has the same number of fits.
    """
    # q and -q are the same source.
    sign = np.where(fits.q[..., 3:] < 0.0, -1.0, 1.0)
    every = replace(fits, q=fits.q * sign).reshape(n_rows, -1)

    def is_same(one: JointFits) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            near = np.abs(every.chi2 - one.chi2[:, None]) < _SAME_CHI2 * (1.0 + 1e-6 * one.chi2[:, None])
            return near & _same_sources(every.q, every.mu, one.q[:, None], one.mu[:, None])

    return every.distinct(width, is_same)


def _same_sources(q: FloatArray, mu: FloatArray, other_q: FloatArray, other_mu: FloatArray) -> NDArray[np.bool_]:
    """Return whether two sets of sources are equal in some order."""
    angle = np.abs(np.einsum("...kd,...ld->...kl", q, other_q)) > np.cos(_SAME_RAD)
    apart = np.linalg.norm(mu[..., :, None, :] - other_mu[..., None, :, :], axis=-1)
    near = angle & (apart < _SAME_MOMENT * np.linalg.norm(mu, axis=-1)[..., None])
    return near.any(axis=-1).all(axis=-1) & near.any(axis=-2).all(axis=-1)


@dataclass(frozen=True, eq=False)
class BeamSearch:
    """Beam search with settings that hold for all readings of a problem.

    Attributes
    ----------
    candidates : ndarray, shape (n, 4)
        Homogeneous coordinates of the positions to start from.
    allowed : callable
        Function of sources (..., 4), (..., 3): whether they agree with the prior.
    width : int
        Number of fits that are kept for every set of readings.
    within : float
        Largest rise of χ² above the best fit for useful fits of one source by moduli.
    n_starts : int
        Number of starts of a restart for every kept fit; half as many again for the first source.
    apart_rad : float
        Least angle between two starts.
    bases : LastBases
        Bases of the candidates.
    """

    candidates: FloatArray
    allowed: Allowed
    width: int = 3
    within: float = math.inf
    n_starts: int = 6
    apart_rad: float = 0.25
    bases: LastBases = field(default_factory=LastBases)

    def first_sources(self, problem: WhitenedModel, y: FloatArray) -> JointFits:
        """Return fits of one source, from the candidates that explain most."""
        bent = self._needs_templates(problem, y)
        if not bent.any() or bent.all():
            return self._first_sources(problem, y, bool(bent.any()))
        fits = JointFits.none((len(y), self.width), 1)
        for templates in (False, True):
            rows = np.flatnonzero(bent == templates)
            fits.put(rows, self._first_sources(problem.rows(rows), y[rows], templates))
        return fits

    def _first_sources(self, problem: WhitenedModel, y: FloatArray, templates: bool) -> JointFits:
        """Return :meth:`first_sources` of rows that all use templates, or all do not."""
        gain = problem.linear_gain(np.zeros_like(problem.ambient))
        residual = y - problem.ambient_signals
        starts: list[tuple[FloatArray, FloatArray]] = []
        if np.any(gain):
            n_starts = 3 * self.n_starts // 2
            q = self.candidates[self._choose(problem, gain, residual, n_starts, self.apart_rad)]
            row = np.repeat(np.arange(len(y)), n_starts)
            # A zero moment suffices: the first step finds the best one. Known moments need a real start.
            mu = np.zeros((len(y), n_starts, 3))
            if problem.known is not None:
                mu = fit_moments(problem.rows(row), y[row], q.reshape(-1, 1, 4)).reshape(mu.shape)
            starts.append((q, mu))
            if problem.known is not None:
                starts.append(
                    starts_of_known_moment(
                        problem, problem.known, residual, self.candidates, self.n_starts, self.apart_rad
                    )
                )
        if templates:
            starts.append(self._template_starts(problem, y))
        q, mu = (np.concatenate(parts, axis=1) for parts in zip(*starts, strict=True))
        if problem.sees_moduli and problem.known is None:
            fits = self._ends(problem, y, q, mu)
        else:
            row = np.repeat(np.arange(len(y)), q.shape[1])
            fits = refine(problem.rows(row), y[row], q.reshape(-1, 1, 4), mu.reshape(-1, 1, 3))
        if problem.is_even:
            fits = fits.with_opposite_moments(len(y))
        return best_distinct(self._apply_prior(fits), len(y), self.width)

    def _ends(self, problem: WhitenedModel, y: FloatArray, q: FloatArray, mu: FloatArray) -> JointFits:
        """Return distinct fits of one source by moduli (b, k, …); empty places have no χ²."""
        signals = signals_of(problem, y - problem.ambient_signals)
        found = search_optima(problem, signals, np.arange(len(y)), q, mu, self.within, _MOST_ITERATIONS)
        chi2 = np.where(np.arange(q.shape[1]) < found.counts[:, :1], found.chi2, np.inf)
        return JointFits(found.q[:, :, None], found.mu[:, :, None], chi2, found.iterations).reshape(-1)

    def _needs_templates(self, problem: WhitenedModel, y: FloatArray) -> NDArray[np.bool_]:
        """Return in which rows (b,) moduli are far from linear.

        There the field of the source is not small compared with the ambient field.
        """
        scalar = problem.channel_is_scalar
        ambient = np.linalg.norm(problem.ambient[:, problem.channel_sensor[scalar]], axis=-1)
        signal = np.abs(y[:, scalar])
        return np.asarray(np.any(signal > 0.2 * ambient * np.abs(problem.gain[:, scalar, 0]), axis=1))

    def _template_starts(self, problem: WhitenedModel, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        directions = hemisphere(_N_TEMPLATE_DIRECTIONS)
        if not problem.channel_is_scalar.all():
            directions = np.concatenate([directions, -directions])
        scores = np.empty((len(y), len(self.candidates)))
        best = np.empty(scores.shape, dtype=np.intp)
        for rows in rows_of_equal_gain(problem.gain):
            templates = self.bases.templates(problem, int(rows[0]), self.candidates, directions)
            for some in np.array_split(rows, -(-rows.size // _ROWS_OF_TEMPLATES)):
                scores[some], best[some] = modulus_scores(templates, y[some])
        n_starts = 3 * self.n_starts
        chosen = distinct_best(scores, self.candidates, n_starts, self.apart_rad)
        q = self.candidates[chosen]
        direction = directions[np.take_along_axis(best, chosen, axis=1)]
        row = np.repeat(np.arange(len(y)), n_starts)
        at = problem.rows(row)
        # Moment without regard to the ambient field.
        fields = at.source_fields(q.reshape(-1, 1, 4), direction.reshape(-1, 1, 3))
        unit = at.without_ambient().predict(fields)
        length = np.sum(unit * y[row], axis=-1) / np.maximum(np.sum(unit * unit, axis=-1), 1e-300)
        return q, direction * np.maximum(length, 1e-30).reshape(len(y), n_starts, 1)

    def _linear_scores(self, problem: WhitenedModel, gain: FloatArray, residual: FloatArray) -> FloatArray:
        scores = np.empty((len(residual), len(self.candidates)))
        for rows in rows_of_equal_gain(gain):
            bases = self.bases_of(problem, gain[rows[0]], int(rows[0]))
            scores[rows] = linear_scores(bases, residual[rows])
        return scores

    def _choose(
        self, problem: WhitenedModel, gain: FloatArray, residual: FloatArray, n_starts: int, apart_rad: float
    ) -> NDArray[np.intp]:
        """Return distinct candidates (b, n_starts) that explain most of the residuals."""
        chosen = np.empty((len(residual), n_starts), dtype=np.intp)
        for rows in rows_of_equal_gain(gain):
            bases = self.bases_of(problem, gain[rows[0]], int(rows[0]))
            chosen[rows] = best_candidates(bases, residual[rows], self.candidates, n_starts, apart_rad)
        return chosen

    def _choose_for_residual(
        self, problem: WhitenedModel, y: FloatArray, q: FloatArray, mu: FloatArray, n_starts: int, apart_rad: float
    ) -> NDArray[np.intp]:
        """Return the candidates that explain most of the residual of sources (b, K, …)."""
        fields = problem.source_fields(q, mu)
        return self._choose(problem, problem.linear_gain(fields), y - problem.predict(fields), n_starts, apart_rad)

    def bases_of(self, problem: WhitenedModel, gain: FloatArray, row: int) -> SingleArray:
        """Return :func:`linear_bases` of the candidates."""
        return self.bases.linear(problem, gain, row, self.candidates)

    def _apply_prior(self, fits: JointFits) -> JointFits:
        """Return the fits with infinite χ² where they contradict the prior."""
        allowed = np.all(self.allowed(fits.q, fits.mu), axis=1)
        return replace(fits, chi2=np.where(allowed, fits.chi2, np.inf))

    def add_source(self, problem: WhitenedModel, y: FloatArray, beam: JointFits, credible: float = 0.0) -> JointFits:
        """Return the beam with one more source, from candidates that explain most of the residual.

        If the first candidates reach a credible χ², fits that will stay far above it are stopped.
        """
        width = beam.chi2.shape[1]
        row = np.repeat(np.arange(len(y)), width)
        q, mu = _fill_missing(beam)
        chosen = self._choose_for_residual(problem.rows(row), y[row], q, mu, width * _MORE_STARTS, self.apart_rad)
        # Copies of the best fit in empty places continue from the next candidates.
        chosen = chosen.reshape(len(y), width, width, _MORE_STARTS)
        turn = np.where(np.isfinite(beam.chi2), 0, np.arange(width))
        chosen = np.take_along_axis(chosen, turn[:, :, None, None], axis=2).reshape(-1, _MORE_STARTS)
        fits = self._extend(problem, y, np.repeat(row, _MORE_STARTS), q, mu, chosen, credible)
        return best_distinct(fits, len(y), self.width)

    def residual_scores(self, problem: WhitenedModel, y: FloatArray, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Return the energy (b, n) that candidates explain of the residual of sources (b, K, …)."""
        fields = problem.source_fields(q, mu)
        return self._linear_scores(problem, problem.linear_gain(fields), y - problem.predict(fields))

    def _extend(
        self,
        problem: WhitenedModel,
        y: FloatArray,
        row: NDArray[np.intp],
        q: FloatArray,
        mu: FloatArray,
        chosen: NDArray[np.intp],
        credible: float = 0.0,
    ) -> JointFits:
        """Refine sources (f, K, …) with each of the chosen candidates (f, n) added.

        `row` is the row of every fit.
        """
        each = np.repeat(np.arange(len(q)), chosen.shape[1])
        at, y_each = problem.rows(row), y[row]
        new = self.candidates[chosen.ravel()][:, None]
        fields = at.source_fields(q[each], mu[each])
        gain, residual = at.linear_gain(fields), y_each - at.predict(fields)
        jacobian = at.moment_jacobian(new, gain)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        trace = np.trace(normal, axis1=1, axis2=2)
        normal += (1e-12 * trace + 1e-300)[:, None, None] * np.eye(3)
        new_mu = np.linalg.solve(normal, jacobian.transpose(0, 2, 1) @ residual[..., None])[:, None, :, 0]
        q, mu = np.concatenate([q[each], new], axis=1), np.concatenate([mu[each], new_mu], axis=1)
        if not credible:
            return self._apply_prior(refine(at, y_each, q, mu))
        place = np.arange(len(q)).reshape(len(y), -1)
        first, others = place[:, :_MORE_STARTS].ravel(), place[:, _MORE_STARTS:].ravel()
        fits = refine(at.rows(first), y_each[first], q[first], mu[first])
        lowest = fits.chi2.reshape(len(y), -1).min(axis=1)
        limit = np.where(lowest <= credible, lowest + DISTINCT_WITHIN, np.inf)
        too_high = np.repeat(limit, place.shape[1] - _MORE_STARTS)
        more = refine(at.rows(others), y_each[others], q[others], mu[others], too_high=too_high)
        return JointFits.none((len(q),), q.shape[1]).replace(first, fits).replace(others, more)

    def remove_source(self, problem: WhitenedModel, y: FloatArray, beam: JointFits) -> JointFits:
        """Return fits with one source fewer: each source of the best fit is removed in turn."""
        n_sources = beam.n_sources
        q, mu = _fill_missing(beam.rows((slice(None), slice(0, 1))))
        others = np.array([[k for k in range(n_sources) if k != out] for out in range(n_sources)])
        q = q[:, others].reshape(-1, n_sources - 1, 4)
        mu = mu[:, others].reshape(-1, n_sources - 1, 3)
        row = np.repeat(np.arange(len(y)), n_sources)
        return best_distinct(self._apply_prior(refine(problem.rows(row), y[row], q, mu)), len(y), self.width)

    def restart(self, problem: WhitenedModel, y: FloatArray, beam: JointFits, rng: np.random.Generator) -> JointFits:
        """Return the beam after random sources are replaced by random good candidates."""
        n_rows, width = beam.chi2.shape
        n_sources, n_tries = beam.n_sources, self.n_starts * self.width
        q, mu = _fill_missing(beam)
        q, mu = q.reshape(n_rows, width, n_sources, 4), mu.reshape(n_rows, width, n_sources, 3)
        which = rng.integers(width, size=(n_rows, n_tries))
        order = np.argsort(rng.random((n_rows, n_tries, n_sources)), axis=-1)[..., : n_sources - 1]
        rows = np.arange(n_rows)[:, None, None]
        kept_q = q[rows, which[..., None], order].reshape(-1, n_sources - 1, 4)
        kept_mu = mu[rows, which[..., None], order].reshape(-1, n_sources - 1, 3)
        row = np.repeat(np.arange(n_rows), n_tries)
        half = 0.5 * self.apart_rad
        best = self._choose_for_residual(problem.rows(row), y[row], kept_q, kept_mu, _RESTART_CANDIDATES, half)
        chosen = best[np.arange(len(row)), rng.integers(_RESTART_CANDIDATES, size=len(row))][:, None]
        fits = self._extend(problem, y, row, kept_q, kept_mu, chosen)
        return merge(beam, best_distinct(fits, n_rows, self.width))


def merge(first: JointFits, second: JointFits) -> JointFits:
    """Return the best distinct fits of two beams with equally many sources."""
    n_rows, width = first.chi2.shape
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    both = JointFits(*(np.concatenate(pair, axis=1) for pair in pairs))
    return best_distinct(both.reshape(-1), n_rows, width)


def _fill_missing(beam: JointFits) -> tuple[FloatArray, FloatArray]:
    """Return sources (b·w, K, …), with the best fit in empty places."""
    missing = ~np.isfinite(beam.chi2)
    q = np.where(missing[..., None, None], beam.q[:, :1], beam.q)
    mu = np.where(missing[..., None, None], beam.mu[:, :1], beam.mu)
    fit = np.isfinite(q).all(axis=(1, 2, 3), keepdims=True)
    # Rows without any fit keep a source far away, which explains nothing.
    q = np.where(fit, q, [1.0, 0.0, 0.0, 1e-3])
    mu = np.where(fit, mu, 0.0)
    return q.reshape(-1, beam.n_sources, 4), mu.reshape(-1, beam.n_sources, 3)
