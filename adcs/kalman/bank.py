"""Selection and run of an attitude filter, and the function estimate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from adcs import quaternion
from adcs.kalman.diagnostics import (
    COLLINEAR,
    FALSE_ALARM,
    collinear_rows,
    contradicts_model,
    unseen_torque_Nm,
    warning_sentences,
)
from adcs.kalman.error_state import (
    ALWAYS,
    DISTURBANCE_S2,
    AttitudeTracks,
    FilterSettings,
    FilterStart,
    sensor_set,
)
from adcs.kalman.initialisation import any_start, choose_start, first_observed_row, vector_start
from adcs.kalman.mekf import run_filter
from adcs.kalman.names import FILTERS, Filter, StartKind, grouped_states
from adcs.kalman.process_noise import torque_scale, tuned_noise
from adcs.kalman.smoother import smooth
from adcs.kalman.variants.constant_gain import run_constant_gain
from adcs.kalman.variants.gyro_driven import run_reduced
from adcs.kalman.variants.self_tuning import run_self_tuned
from adcs.kalman.variants.separate_bias import run_parallel
from adcs.satellite.attitude_track import AttitudeTrack, join_tracks
from adcs.satellite.conventions import check_conventions
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import SENSOR_WORDS, SENSORS
from adcs.satellite.telemetry import Record, Telemetry, orbital_from_eci, part
from arrays.io.errors import InputError, naming

IMPLIED_STATES = {"parallel-disturbance": ("disturbance",), "reduced": ("gyro-bias",), "self-tuning": ("disturbance",)}
"""States that a filter always estimates."""
_CURES = (
    ("disturbance",),
    ("dipole",),
    ("disturbance", "dipole"),
    ("field-model",),
    ("disturbance", "dipole", "field-model"),
)
_MOST_TRIED = 10_000


@dataclass(frozen=True, eq=False)
class EstimatorSettings:
    """Filter, its sensors and states, and its start.

    Attributes
    ----------
    settings : FilterSettings
        Sensors, states and noise of the filter.
    filter : str
        One of :data:`adcs.kalman.names.FILTERS`.
    start : str
        One of :data:`adcs.kalman.names.STARTS`, for simulations; :func:`estimate` starts from any attitude. With a
        magnetometer alone, another start is used if it explains the readings better.
    start_attitude_rad, start_rate_rad_s : float
        Initial standard deviations per axis.
    forgetting : float
        Forgetting factor of the parallel filter of the disturbance.
    closed_loop_F : bool
        Whether to use the closed-loop Jacobian of the source paper.
    longest_gap_s : float
        Longest gap of a log that the filter bridges by the dynamics; it restarts after a longer one.

    Examples
    --------
    >>> import adcs
    >>> adcs.EstimatorSettings.of("st+gyro", states=["gyro-bias"], filter="smoother").in_words
    'st+gyro, estimating gyro-bias; filter smoother'
    """

    settings: FilterSettings
    filter: Filter = "mekf"
    start: StartKind = "any"
    start_attitude_rad: float = math.radians(5.0)
    start_rate_rad_s: float = math.radians(0.1)
    forgetting: float = 0.99
    closed_loop_F: bool = False
    longest_gap_s: float = 600.0

    @classmethod
    def of(
        cls,
        sensors: str,
        states: Iterable[str] = (),
        filter: Filter = "mekf",
        inertia_kgm2: ArrayLike | None = None,
    ) -> EstimatorSettings:
        """Return settings by names, with tuned process noise.

        Parameters
        ----------
        sensors : str
            Sensors in use, such as ``"mag+sun+gyro"``.
        states : iterable of str
            States besides attitude and rate.
        filter : str
            One of :data:`adcs.kalman.names.FILTERS`.
        inertia_kgm2 : array_like, shape (3, 3), optional
            Inertia of the satellite; the smaller it is, the more process noise. By default that of TabletSat-Aurora.

        Returns
        -------
        EstimatorSettings
            Settings for :func:`adcs.estimate`.

        Raises
        ------
        ValueError
            A name is unknown, or the sensors cannot observe the attitude or a state.
        """
        if filter not in FILTERS:
            raise ValueError(f"Input filter must be one of {', '.join(FILTERS)}; instead received {filter!r}.")
        used = sensor_set(sensors, dict.fromkeys((*states, *IMPLIED_STATES.get(filter, ()))))
        prior_s2 = DISTURBANCE_S2 * torque_scale(inertia_kgm2)
        return cls(FilterSettings(used, tuned_noise(used, inertia_kgm2), disturbance_sigma_s2=prior_s2), filter)

    @property
    def in_words(self) -> str:
        """Sensors, states and filter in words."""
        used = self.settings.sensors
        states = f", estimating {', '.join(used.states)}" if used.states else ""
        return f"{used.sensors}{states}; filter {self.filter}"


def estimate(
    telemetry: Telemetry,
    satellite: Satellite,
    *,
    sensors: str | EstimatorSettings,
    states: Iterable[str] = (),
    filter: Filter = "mekf",
) -> AttitudeTrack:
    """Estimate attitude and rate of a satellite from its log by an error-state Kalman filter.

    Field and Sun are computed along the orbit. The filter starts from the first readings. If these leave a rotation
    open, it starts from the angle that fits the readings of five minutes best; with a magnetometer alone, of fifty
    minutes. It restarts after a gap of more than ten minutes, or of ``longest_gap_s`` of the settings.

    Parameters
    ----------
    telemetry : Telemetry
        Log from :func:`adcs.read_telemetry`, or from arrays.
    satellite : Satellite
        Inertia, orbit, sensors and their noise.
    sensors : str or EstimatorSettings
        Sensors in use: ``st``, ``gyro``, ``mag`` and ``sun`` with + between them, such as ``"mag+sun+gyro"``; or all
        settings, which replace ``states`` and ``filter`` too.
    states : iterable of str
        States besides attitude and rate: ``gyro-bias``, ``field-bias``, ``disturbance``, ``field-model``, ``dipole``,
        ``field-gain``.
    filter : str
        ``mekf``: the multiplicative extended Kalman filter. ``constant-gain``: the same with its converged gain.
        ``parallel-disturbance``: with a separate filter of the disturbance. ``reduced``: attitude and gyro bias alone.
        ``smoother``: with a smoother after it. ``self-tuning``: a bank that estimates the size of the disturbance.

    Returns
    -------
    AttitudeTrack
        Attitude, inertial from body, with rate, states, standard deviations and warnings.

    Raises
    ------
    ValueError
        The sensors cannot observe the attitude or have no reading, one misread unit, axis or quaternion explains why
        they contradict each other, a date is outside of the field model, or the filter fails.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> sensors, states = "st+gyro", ["gyro-bias"]
    >>> attitude = adcs.estimate(log.telemetry, log.satellite, sensors=sensors, states=states)
    >>> error = (attitude.rotation[-1] * log.truth[-1].inv()).magnitude()
    >>> bool(error < 1e-3)
    True
    """
    body = satellite.body
    chosen = EstimatorSettings.of(sensors, states, filter, body.inertia_kgm2) if isinstance(sensors, str) else sensors
    pieces = telemetry.pieces(chosen.longest_gap_s)
    if len(pieces) == 1:
        return _estimate(telemetry, satellite, chosen)
    tracks, reasons = [], []
    for piece in pieces:
        try:
            tracks.append(_estimate(piece, satellite, chosen))
        except ValueError as error:
            reasons.append(error)
    if not tracks:
        raise reasons[0]
    failed = f"; {len(reasons)} of the {len(pieces)} pieces determine no attitude: {reasons[0]}" if reasons else ""
    gaps = f"{len(pieces) - 1} gaps longer than {chosen.longest_gap_s:g} s: the filter starts anew after each{failed}"
    return join_tracks(tracks, gaps)


def _estimate(telemetry: Telemetry, satellite: Satellite, chosen: EstimatorSettings) -> AttitudeTrack:
    """Estimate the track of a log without a long gap."""
    used = chosen.settings.sensors
    record = telemetry.record(satellite)
    for name in used.sensors.split("+"):
        if not record.readings.seen[name].any():
            raise ValueError(
                f"Input telemetry must have readings of the {SENSOR_WORDS[name]} for the sensors {used.sensors}; "
                "instead received none."
            )
    warnings = check_conventions(telemetry, record, used.sensors.split("+"))
    first = first_observed_row(record, used, with_gyro=chosen.filter == "reduced")
    record = part(record, np.array([0]), slice(first, None))
    tracks = estimate_tracks(record, chosen, any_start)
    if not (np.isfinite(tracks.q).all() and tracks.definite.all()):
        raise ValueError("Input telemetry must have readings that an attitude explains; instead the filter found none.")
    track = _track(telemetry, first, record, chosen, tracks)
    return replace(track, warnings=(*warnings, *track.warnings, *_missing_states(record, chosen, tracks)))


def _missing_states(record: Record, chosen: EstimatorSettings, tracks: AttitudeTracks) -> list[str]:
    """Return a sentence on states that explain the readings better, where these contradict the model.

    Filters with more states run over the first :data:`_MOST_TRIED` instants. The likeliest of those without a
    contradiction is named; without one, the likeliest of all.
    """
    used = chosen.settings.sensors
    if chosen.filter not in ("mekf", "smoother") or not contradicts_model(record, tracks, 0):
        return []
    rows = slice(_MOST_TRIED)
    start, inertia = part(record, np.array([0]), rows), record.satellite.body.inertia_kgm2
    limit = _misfit(tracks, rows) - chi2.isf(FALSE_ALARM, 9)
    found: list[tuple[bool, float, tuple[str, ...]]] = []
    for added in _CURES:
        if "field-model" in added and not used.magnetometer:
            continue
        trial = sensor_set(used.sensors, dict.fromkeys((*used.states, *added)))
        if trial.states == used.states:
            continue
        settings = replace(
            chosen.settings,
            sensors=trial,
            noise=tuned_noise(trial, inertia),
            disturbance_sigma_s2=max(chosen.settings.disturbance_sigma_s2, DISTURBANCE_S2 * torque_scale(inertia)),
        )
        tried = estimate_tracks(start, replace(chosen, settings=settings, filter="mekf"), any_start)
        if (misfit := _misfit(tried, rows)) < limit:
            found.append((contradicts_model(start, tried, 0), misfit, trial.states))
    if not found:
        return []
    names = ", ".join(f'"{state}"' for state in grouped_states(min(found)[2]))
    return [
        f"the readings fit better with states = [{names}] in the table estimate: a torque or a field is not in the "
        "model, such as that of a residual dipole, or of an error of the orbit"
    ]


def _misfit(tracks: AttitudeTracks, rows: slice) -> float:
    """Return minus twice the log-likelihood of the readings of some rows of the first run; infinite if it fails."""
    if not np.isfinite(tracks.q).all():
        return math.inf
    nis = np.minimum(tracks.nis[0, rows], tracks.settings.gate_limit)
    return float(np.nansum(nis + tracks.log_det[0, rows]))


def _track(
    telemetry: Telemetry, first: int, record: Record, chosen: EstimatorSettings, tracks: AttitudeTracks
) -> AttitudeTrack:
    """Return the only run as a track, which begins at row ``first`` of the log."""
    used, q = chosen.settings.sensors, tracks.q[0]
    return AttitudeTrack(
        title=chosen.in_words,
        time_s=telemetry.instants_s[first:],
        rows=telemetry.rows[telemetry.rows >= first] - first,
        q=quaternion.multiply(quaternion.conjugate(orbital_from_eci(record.environment)[0]), q),
        states={state: values[0] for state, values in tracks.states.items()},
        used=tuple(used.sensors.split("+")),
        seen={name: seen[0] for name, seen in record.readings.seen.items()},
        sigma={state: sigma[0] for state, sigma in tracks.sigma_by_state.items()},
        nis=dict(zip(SENSORS, tracks.nis[0].T, strict=True)),
        q_orbital=q,
        warnings=warning_sentences(record, tracks)[0],
        gated=dict(zip(SENSORS, tracks.rejected[0].T, strict=True)),
        degraded={COLLINEAR: collinear_rows(record, used, 0)},
        unseen_torque_Nm=unseen_torque_Nm(record, tracks, 0),
        tuned_disturbance_s2=None if tracks.tuned_disturbance_s2 is None else tracks.tuned_disturbance_s2[0],
    )


def estimate_tracks(
    record: Record,
    chosen: EstimatorSettings,
    start: FilterStart | Callable[[Record, FilterSettings], FilterStart] | None = None,
) -> AttitudeTracks:
    """Run the chosen filter from a start, or from a function that finds one.

    By default the settings choose that function.
    """
    start = start or (vector_start if chosen.start == "vectors" else any_start)
    with naming(f"filter {chosen.filter}"):
        try:
            # Overflow makes the result not finite, which the caller reports.
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                if isinstance(start, FilterStart):
                    first = choose_start(record, chosen.settings, start)
                else:
                    first = start(record, chosen.settings)
                return _run_chosen(record, chosen, first)
        except np.linalg.LinAlgError:
            raise InputError(
                f"filter {chosen.filter}: found a covariance that is no longer positive definite, expected noise of "
                "the size of the readings' errors, a shorter duration or another filter."
            ) from None


def _run_chosen(record: Record, chosen: EstimatorSettings, start: FilterStart) -> AttitudeTracks:
    settings = chosen.settings
    if chosen.filter == "constant-gain":
        return run_constant_gain(record, settings, start)
    if chosen.filter in ("parallel-disturbance", "self-tuning"):
        # The filter that found the start has another disturbance state.
        start = FilterStart(start.q, start.w, start.covariance[:, :ALWAYS, :ALWAYS])
    if chosen.filter == "parallel-disturbance":
        return run_parallel(record, settings, start, forgetting=chosen.forgetting)
    if chosen.filter == "reduced":
        return run_reduced(record, settings, start)
    if chosen.filter == "self-tuning":
        return run_self_tuned(record, settings, start)
    tracks = run_filter(record, settings, start, closed_loop_F=chosen.closed_loop_F)
    return smooth(record, tracks) if chosen.filter == "smoother" else tracks
