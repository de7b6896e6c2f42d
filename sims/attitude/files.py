"""The simulation of a scenario file of ``adcs``."""

from __future__ import annotations

import math

from adcs.io.scenario_files import AttitudeFile
from arrays.io.errors import naming
from sims.attitude.scenario import AttitudeScenario, StartConditions


def simulation_of(file: AttitudeFile) -> AttitudeScenario:
    """Return the scenario of a simulation.

    ``file``: of :func:`adcs.io.scenario_files.read_scenario`.
    """
    start, disturbance = file.start, file.disturbance
    with naming(file.path):
        return AttitudeScenario(
            file.satellite,
            conditions=StartConditions(
                sunlit=start.sunlit,
                least_separation_rad=math.radians(start.least_separation_deg),
                most_separation_rad=math.radians(start.most_separation_deg),
                least_field_T=1e-9 * start.least_field_nT,
                eclipse_after_s=start.eclipse_after_s,
            ),
            duration_s=file.duration_s,
            dt_s=file.step_s,
            torque_Nm=disturbance.torque_Nm,
            torque_period_s=disturbance.torque_period_s,
            gyro_bias_rad_s=math.radians(disturbance.gyro_bias_deg_s),
            field_bias_T=1e-9 * disturbance.field_bias_nT,
            field_gain=disturbance.field_gain,
            field_axes_rad=math.radians(disturbance.field_axes_deg),
            field_error_T=1e-9 * disturbance.field_error_nT,
            field_error_correlation_s=disturbance.field_error_correlation_s,
            dipole_Am2=disturbance.dipole_Am2,
            wild_share=disturbance.wild_share,
            start_attitude_rad=math.radians(start.attitude_deg),
            start_rate_rad_s=math.radians(start.rate_deg_s),
        )
