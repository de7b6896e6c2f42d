"""Arrays of magnetometers: sensors, positions, noise and differences between sensors."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "GEOMETRIES": "arrays.geometries",
        "Calibration": "arrays.sensor",
        "Instrument": "arrays.instruments.templates",
        "InputError": "arrays.io.errors",
        "LogColumns": "arrays.columns",
        "ValidRows": "arrays.columns",
        "PoseUncertainty": "arrays.pose",
        "SENSOR_PRESETS": "arrays.presets",
        "Sensor": "arrays.sensor",
        "SensorArray": "arrays.array",
        "SensorKind": "arrays.sensor",
        "SensorPreset": "arrays.presets",
        "array_toml": "arrays.array_file",
        "axial": "arrays.geometries",
        "cross": "arrays.geometries",
        "cube": "arrays.geometries",
        "grid": "arrays.geometries",
        "hexagon": "arrays.geometries",
        "instrument_names": "arrays.instruments.templates",
        "mesh_of": "arrays.meshes",
        "read_array": "arrays.array_file",
        "read_instrument": "arrays.instruments.templates",
        "read_sensors": "arrays.array_file",
        "square": "arrays.geometries",
        "tetrahedron": "arrays.geometries",
        "write_array": "arrays.array_file",
    },
)
