"""The bank of filters: picks the filter that is asked for, and runs it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.kalman.diagnostics import COLLINEAR, collinear_rows, unseen_torque_Nm, warnings_of
from adcs.kalman.error_state import ALWAYS, AttitudeTracks, FilterSettings, Start, sensor_set, tuned_noise
from adcs.kalman.initialisation import any_start, checked_start, first_told, vector_start
from adcs.kalman.mekf import run_filter
from adcs.kalman.names import FILTERS, Filter, StartKind
from adcs.kalman.smoother import smoothed
from adcs.kalman.variants.constant_gain import run_constant_gain
from adcs.kalman.variants.gyro_driven import run_reduced
from adcs.kalman.variants.self_tuning import run_self_tuned
from adcs.kalman.variants.separate_bias import run_parallel
from adcs.satellite.attitude_track import AttitudeTrack, joined
from adcs.satellite.conventions import check_conventions
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import SENSOR_WORDS, SENSORS
from adcs.satellite.telemetry import Record, Telemetry, orbital_from_eci, part
from arrays.io.errors import InputError, naming

IMPLIED_STATES = {"parallel-disturbance": ("disturbance",), "reduced": ("gyro-bias",), "self-tuning": ("disturbance",)}
"""What a filter estimates whether it is asked to or not."""


@dataclass(frozen=True, eq=False)
class EstimatorSettings:
    """What is estimated, from what, and how.

    Attributes
    ----------
    settings : FilterSettings
        Sensors, states and what the filter believes of their noise.
    filter : str
        One of :data:`adcs.kalman.names.FILTERS`.
    start : str
        One of :data:`adcs.kalman.names.STARTS`, for simulations; :func:`estimate` starts from any attitude. With a
        magnetometer alone any other attitude is taken that explains the readings better.
    start_attitude_rad, start_rate_rad_s : float
        Standard deviations per axis of what it starts from.
    forgetting : float
        Of the parallel filter of the disturbance.
    closed_loop_F : bool
        The source paper's Jacobian.
    longest_gap_s : float
        Through which the filter coasts on the dynamics, where a log has no row; after a longer one it starts anew.

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
    def of(cls, sensors: str, states: Iterable[str] = (), filter: Filter = "mekf") -> EstimatorSettings:
        """Settings by names, with the process noise that we found."""
        if filter not in FILTERS:
            raise ValueError(f"Input filter must be one of {', '.join(FILTERS)}; instead received {filter!r}.")
        used = sensor_set(sensors, dict.fromkeys((*states, *IMPLIED_STATES.get(filter, ()))))
        return cls(FilterSettings(used, tuned_noise(used)), filter)

    @property
    def in_words(self) -> str:
        """Sensors, states and filter."""
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
    """Attitude and rate of a satellite from its log, by an error-state Kalman filter.

    Field and Sun are computed along the orbit. The filter starts from the first readings; where they leave a turn
    open, from the turn that fits the readings of five minutes, or fifty of a magnetometer alone. After a gap of more
    than ten minutes, or what the settings say, it starts anew.

    Parameters
    ----------
    telemetry : Telemetry
        The log: of :func:`adcs.read_telemetry`, or of arrays.
    satellite : Satellite
        Inertia, orbit, sensors and their noise, as its user knows them.
    sensors : str or EstimatorSettings
        Sensors in use, ``st``, ``gyro``, ``mag`` and ``sun`` with + between them, such as ``"mag+sun+gyro"``; or
        everything that a filter may be told, in place of states and filter too.
    states : iterable of str
        What is estimated besides attitude and rate: ``gyro-bias``, ``field-bias``, ``disturbance``,
        ``field-model``, ``dipole``, ``field-gain``.
    filter : str
        ``mekf``; with its converged gain (``constant-gain``); with a filter of the disturbance beside it
        (``parallel-disturbance``); of attitude and gyro bias alone (``reduced``); with a smoother after it
        (``smoother``); a bank that finds how large the disturbance is (``self-tuning``).

    Returns
    -------
    AttitudeTrack
        Inertial from body.

    Raises
    ------
    ValueError
        The sensors cannot observe attitude or have no reading, one misreading of a sensor (its unit, axes or
        quaternion) explains why they contradict each other, a date is outside of the model of the field, or the filter
        fails.

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
    chosen = EstimatorSettings.of(sensors, states, filter) if isinstance(sensors, str) else sensors
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
    told = f"; {len(reasons)} of the {len(pieces)} pieces tell no attitude: {reasons[0]}" if reasons else ""
    anew = f"{len(pieces) - 1} gaps longer than {chosen.longest_gap_s:g} s: the filter starts anew after each{told}"
    return joined(tracks, anew)


def _estimate(telemetry: Telemetry, satellite: Satellite, chosen: EstimatorSettings) -> AttitudeTrack:
    """Track of a log without a long gap."""
    used = chosen.settings.sensors
    record = telemetry.record(satellite)
    for name in used.sensors.split("+"):
        if not record.readings.seen[name].any():
            raise ValueError(
                f"Input found no reading of the {SENSOR_WORDS[name]}, expected some because the sensors in use are "
                f"{used.sensors}."
            )
    check_conventions(telemetry, record, used.sensors.split("+"))
    first = first_told(record, used, with_gyro=chosen.filter == "reduced")
    record = part(record, np.array([0]), slice(first, None))
    tracks = estimated(record, chosen, any_start)
    if not (np.isfinite(tracks.q).all() and tracks.definite.all()):
        raise ValueError("Input found readings that no attitude explains: the filter has failed.")
    return _track(telemetry, first, record, chosen, tracks)


def _track(
    telemetry: Telemetry, first: int, record: Record, chosen: EstimatorSettings, tracks: AttitudeTracks
) -> AttitudeTrack:
    """The only run of some tracks, from an instant of its log on."""
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
        warnings=warnings_of(record, tracks)[0],
        gated=dict(zip(SENSORS, tracks.rejected[0].T, strict=True)),
        degraded={COLLINEAR: collinear_rows(record, used, 0)},
        unseen_torque_Nm=unseen_torque_Nm(record, tracks, 0),
        tuned_disturbance_s2=None if tracks.tuned_disturbance_s2 is None else tracks.tuned_disturbance_s2[0],
    )


def estimated(
    record: Record, chosen: EstimatorSettings, start: Start | Callable[[Record, FilterSettings], Start] | None = None
) -> AttitudeTracks:
    """Tracks of the filter that is wanted, from a start or what finds one; by default as the settings say."""
    start = start or (vector_start if chosen.start == "vectors" else any_start)
    with naming(f"filter {chosen.filter}"):
        try:
            # What leaves double precision is not finite in the end, which is for the caller to tell.
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                if isinstance(start, Start):
                    first = checked_start(record, chosen.settings, start)
                else:
                    first = start(record, chosen.settings)
                return _estimated(record, chosen, first)
        except np.linalg.LinAlgError:
            raise InputError(
                f"filter {chosen.filter}: found a covariance that is not positive definite any more, expected noise of "
                "the size of the readings' errors, a shorter duration or another filter."
            ) from None


def _estimated(record: Record, chosen: EstimatorSettings, start: Start) -> AttitudeTracks:
    settings = chosen.settings
    if chosen.filter == "constant-gain":
        return run_constant_gain(record, settings, start)
    if chosen.filter in ("parallel-disturbance", "self-tuning"):
        # Their disturbance is not that of the filter by which the start was found.
        start = Start(start.q, start.w, start.covariance[:, :ALWAYS, :ALWAYS])
    if chosen.filter == "parallel-disturbance":
        return run_parallel(record, settings, start, forgetting=chosen.forgetting)
    if chosen.filter == "reduced":
        return run_reduced(record, settings, start)
    if chosen.filter == "self-tuning":
        return run_self_tuned(record, settings, start)
    tracks = run_filter(record, settings, start, closed_loop_F=chosen.closed_loop_F)
    return smoothed(record, tracks) if chosen.filter == "smoother" else tracks
