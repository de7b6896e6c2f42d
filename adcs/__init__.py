"""Attitude of satellites and of anything else that turns: error-state Kalman, complementary and set-valued filters."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "AttitudeTrack": "adcs.satellite.attitude_track",
        "BDot": "adcs.satellite.magnetic_control",
        "BoundedSystem": "adcs.ellipsoids.observer",
        "Ellipsoid": "adcs.ellipsoids.ellipsoid",
        "EllipsoidObserver": "adcs.ellipsoids.observer",
        "EstimatorSettings": "adcs.kalman.bank",
        "Gains": "adcs.complementary.explicit",
        "MagnetometerPrior": "adcs.satellite.magnetometer_calibration",
        "OwnFields": "adcs.satellite.own_fields",
        "Satellite": "adcs.satellite.satellite",
        "Telemetry": "adcs.satellite.telemetry",
        "VectorAttitudes": "adcs.satellite.wahba",
        "attitude_of_vectors": "adcs.satellite.wahba",
        "b_dot_gain": "adcs.satellite.magnetic_control",
        "calibrate_magnetometer": "adcs.satellite.magnetometer_calibration",
        "circular_orbit": "adcs.environment.orbit",
        "complementary_filter": "adcs.complementary.filters",
        "datasets": ":adcs.datasets",
        "detumbled": "adcs.satellite.magnetic_control",
        "estimate": "adcs.kalman.bank",
        "find_own_fields": "adcs.satellite.own_fields",
        "frames": ":adcs.frames",
        "identify_stars": "adcs.stars.identification",
        "inertial_magnetic_filter": "adcs.complementary.filters",
        "mockup": ":adcs.mockup",
        "read_scenario": "adcs.io.scenario_files",
        "read_telemetry": "adcs.io.telemetry_files",
        "vector_attitude": "adcs.satellite.vectors",
    },
)
