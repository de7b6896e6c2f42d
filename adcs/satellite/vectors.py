"""Attitude of a satellite from field and Sun for each row of its log."""

from __future__ import annotations

import numpy as np

from adcs import quaternion
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.conventions import check_conventions
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry, orbital_from_eci
from adcs.satellite.wahba import VectorMethod, attitude_of_vectors


def vector_attitude(telemetry: Telemetry, satellite: Satellite, *, method: VectorMethod = "quest") -> AttitudeTrack:
    """Estimate the attitude of a satellite independently at each row with field and Sun.

    Parameters
    ----------
    telemetry : Telemetry
        Log with magnetometer and Sun sensor.
    satellite : Satellite
        Orbit, and noise of the sensors.
    method : str
        Method of :func:`adcs.attitude_of_vectors`; the first vector of ``triad`` is the Sun.

    Returns
    -------
    AttitudeTrack
        Attitude, inertial from body, at the rows with both sensors; it has no rate.

    Raises
    ------
    ValueError
        No row has both sensors, one misreading explains why the log contradicts the orbit, or a date is outside of the
        field model.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> track = adcs.vector_attitude(log.telemetry, log.satellite)
    >>> bool((track.rotation * log.truth.inv()).magnitude().max() < 0.05)
    True
    """
    record = telemetry.record(satellite)
    check_conventions(telemetry, record, ("mag", "sun"))
    around, readings = record.environment, record.readings
    field_T, sun = readings.field_T[0], readings.sun[0]
    sigma_field = satellite.magnetometer.sigma_T / np.linalg.norm(field_T, axis=-1)
    found = attitude_of_vectors(
        [sun, field_T],
        [around.sun_orbital[0], around.b_orbital_T[0]],
        [satellite.sun_sensor.sigma_rad, sigma_field],
        method=method,
    )
    at = np.flatnonzero(np.isfinite(found.loss))
    if not at.size:
        raise ValueError(
            "Input telemetry must have a row with both magnetometer and Sun sensor; instead received none."
        )
    q = found.q[at]
    return AttitudeTrack(
        title=f"mag+sun, row by row; {method}",
        time_s=telemetry.instants_s[at],
        rows=np.arange(len(at)),
        q=quaternion.multiply(quaternion.conjugate(orbital_from_eci(around)[0, at]), q),
        states={},
        used=("mag", "sun"),
        seen={name: seen[0, at] for name, seen in readings.seen.items()},
        sigma={"attitude": np.sqrt(np.diagonal(found.covariance[at], axis1=-2, axis2=-1))},
        q_orbital=q,
    )
