"""Attitude scenario: satellite, orbit, disturbances and conditions of the start."""

from __future__ import annotations

import math
from dataclasses import dataclass

from adcs.satellite.magnetic_control import HysteresisRods
from adcs.satellite.satellite import Satellite
from arrays.io.errors import check_not_negative


@dataclass(frozen=True)
class StartConditions:
    r"""Conditions that hold from the start of a run to its end.

    Attributes
    ----------
    sunlit : bool
        The Sun is seen throughout.
    least_separation_rad, most_separation_rad : float
        Bounds of the angle between the lines of Sun and field: the first throughout, the second at least once.
    least_field_T : float
        \|B\| throughout.
    eclipse_after_s : float or None
        The Sun is seen until then, and not at that time.
    """

    sunlit: bool = True
    least_separation_rad: float = math.radians(45.0)
    most_separation_rad: float = math.radians(90.0)
    least_field_T: float = 25e-6
    eclipse_after_s: float | None = None


@dataclass(frozen=True, eq=False)
class AttitudeScenario:
    """Satellite whose wheels hold the orbital frame.

    Directions of torque, biases and errors are random, one for every run.

    Attributes
    ----------
    satellite : Satellite
        Satellite; runs start within 24 hours from its start, and its control knows the true state.
    conditions : StartConditions
        Conditions of Sun and field that hold throughout a run.
    duration_s, dt_s : float
        Duration of a run, and step between its instants, at which readings are taken and torques are set.
    torque_Nm : float
        Size of a disturbing torque that is constant in the body.
    torque_period_s : float
        Period of that torque; infinite = constant.
    gyro_bias_rad_s, field_bias_T : float
        Sizes of the biases at the start.
    field_gain, field_axes_rad : float
        Standard deviations of the errors of the magnetometer's gains, and of the errors of its axes.
    field_error_T : float
        Size of the difference between the true field and its model, constant in the orbital frame.
    field_error_correlation_s : float
        Correlation time of each component of that difference, with ``field_error_T`` as standard deviation; infinite =
        constant.
    dipole_Am2 : tuple of 3 floats
        Magnetic dipole of the body that filters do not know, in addition to the residual dipole of the satellite.
    rods : HysteresisRods or None
        Hysteresis rods on board, across a magnet; filters do not know them.
    wild_share : float
        Share of wild readings of every sensor.
    start_attitude_rad, start_rate_rad_s : float
        Standard deviations, per axis, of attitude and rate from those of the orbital frame.

    Raises
    ------
    ValueError
        A duration or step is not positive, or a size is negative.

    Examples
    --------
    >>> import sims
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("tabletsat"), duration_s=60.0)
    >>> scenario.satellite.field_model
    'IGRF-14'
    """

    satellite: Satellite
    conditions: StartConditions = StartConditions()
    duration_s: float = 200.0
    dt_s: float = 1.0
    torque_Nm: float = 0.0
    torque_period_s: float = math.inf
    gyro_bias_rad_s: float = 0.0
    field_bias_T: float = 0.0
    field_gain: float = 0.0
    field_axes_rad: float = 0.0
    field_error_T: float = 0.0
    field_error_correlation_s: float = math.inf
    dipole_Am2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rods: HysteresisRods | None = None
    wild_share: float = 0.0
    start_attitude_rad: float = math.radians(1.0)
    start_rate_rad_s: float = math.radians(0.01)

    def __post_init__(self) -> None:
        for name in ("dt_s", "torque_period_s", "field_error_correlation_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"Input {name} must be positive; instead received {getattr(self, name)}.")
        if not self.dt_s <= self.duration_s < math.inf:
            raise ValueError(f"Input duration_s must be dt_s or more and finite; instead received {self.duration_s}.")
        if not 0.0 <= self.wild_share <= 1.0:
            raise ValueError(f"Input wild_share must be 0 to 1; instead received {self.wild_share}.")
        sizes = ("torque_Nm", "gyro_bias_rad_s", "field_bias_T", "field_gain", "field_axes_rad", "field_error_T")
        names = (*sizes, "start_attitude_rad", "start_rate_rad_s")
        check_not_negative(**{name: getattr(self, name) for name in names})

    @property
    def n_instants(self) -> int:
        """Number of instants of a run, including the start."""
        return 1 + round(self.duration_s / self.dt_s)
