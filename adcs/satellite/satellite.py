"""Description of a satellite by its user."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from adcs.environment.orbit import Orbit
from adcs.frames import instants
from adcs.satellite.dynamics import RigidBody, WheelControl, wheel_control
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker, SunSensor
from magloc.fields.geomagnetic import Model


@dataclass(frozen=True, eq=False, kw_only=True)
class Satellite:
    """Satellite with its orbit and its sensors.

    Attributes
    ----------
    inertia_kgm2 : ndarray, shape (3, 3)
        Inertia with the wheels, body axes.
    orbit : Orbit
        Orbit, such as :func:`adcs.circular_orbit` or :class:`adcs.environment.orbit.Sgp4Orbit`.
    residual_dipole_Am2 : ndarray, shape (3,)
        Magnetic moment that stays with the satellite, body axes.
    star_tracker, gyro, magnetometer, sun_sensor : StarTracker, Gyro, Magnetometer, SunSensor
        Sensors of :mod:`adcs.satellite.sensors`, with the noise that the filters assume; by default that of
        TabletSat-Aurora.
    control : WheelControl
        Wheel control, used by simulations and by the Jacobian of the closed loop.
    start : datetime64
        UTC of time zero of the telemetry; by default the orbit's epoch.
    field_model : str or Coefficients
        Model of the geomagnetic field: "IGRF-14" (1900 to 2030) or "WMM2025".
    body : RigidBody
        Inertia and dipole, checked.

    Raises
    ------
    ValueError
        No rigid body has this inertia.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> orbit = adcs.circular_orbit(
    ...     altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21"
    ... )
    >>> satellite = adcs.Satellite(inertia_kgm2=np.diag([0.05, 0.06, 0.03]), orbit=orbit)
    >>> satellite.start
    np.datetime64('2026-11-21T00:00:00.000000')
    """

    inertia_kgm2: ArrayLike
    orbit: Orbit
    residual_dipole_Am2: ArrayLike = (0.0, 0.0, 0.0)
    star_tracker: StarTracker = field(default_factory=StarTracker)
    gyro: Gyro = field(default_factory=Gyro)
    magnetometer: Magnetometer = field(default_factory=Magnetometer)
    sun_sensor: SunSensor = field(default_factory=SunSensor)
    control: WheelControl = None  # type: ignore[assignment]  # filled in from the body
    start: np.datetime64 = None  # type: ignore[assignment]  # the orbit's epoch
    field_model: Model = "IGRF-14"
    body: RigidBody = field(init=False)

    def __post_init__(self) -> None:
        body = RigidBody(np.asarray(self.inertia_kgm2, dtype=np.float64), np.asarray(self.residual_dipole_Am2))
        object.__setattr__(self, "body", body)
        if self.control is None:
            object.__setattr__(self, "control", wheel_control(body))  # type: ignore[unreachable]
        start = self.orbit.epoch if self.start is None else self.start  # type: ignore[redundant-expr]
        object.__setattr__(self, "start", instants(start)[()])
