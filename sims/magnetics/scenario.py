"""Magnetic scenario: array, sensors, sources, fields and noise, in SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from arrays.array import SensorArray
from arrays.io.errors import check_positive
from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc.fields.multipole import check_body_length
from magloc.signature.path import PathError
from sims.magnetics.ground import Geology, Targets
from sims.magnetics.paths import Attitude, Path, Steered, Vector
from sims.magnetics.sensors import SensorModel, nominal_array

Matrix = tuple[Vector, Vector, Vector]
MOST_ROWS = 1_000_000
_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Carrier:
    """Path of an array or a source in the world frame, and its attitude along it."""

    path: Path = field(default_factory=Steered)
    attitude: Attitude = field(default_factory=Attitude)

    @property
    def is_world(self) -> bool:
        """Return whether the frame equals the world: at rest in the origin, not turned."""
        path = self.path
        if not isinstance(path, Steered) or path.speed_m_s or path.climb_m_s or any(path.start_m):
            return False
        return self.attitude.is_world


@dataclass(frozen=True)
class Source:
    """Dipole fixed to a body, or a bar.

    Its moment in body axes is :math:`m = m_{permanent} + α B_a/μ_0` with the ambient field B_a in body axes. Only the
    main ambient field magnetises it, not its pulsations.

    Attributes
    ----------
    carrier : Carrier
        Motion of the body.
    moment_Am2 : tuple, shape (3,)
        Permanent part, body axes.
    polarisability_m3 : tuple of tuples, shape (3, 3)
        α: volume times susceptibility, demagnetisation included; 4π a³ for a sphere of iron of radius a.
    radius_m : float
        Radius of the body; sensors must stay outside.
    body_length_m : float
        Length of a thin bar along the body's axis x with this moment, uniformly distributed. 0 for a point source. No
        sensor may come nearer to its centre than that length.
    path_error : PathError
        Errors of its stated path and attitude.
    from_s, until_s : float
        Times between which the source exists; its truth has only these rows.
    """

    carrier: Carrier = field(default_factory=Carrier)
    moment_Am2: Vector = _ZERO
    polarisability_m3: Matrix = (_ZERO, _ZERO, _ZERO)
    radius_m: float = 0.0
    path_error: PathError = field(default_factory=PathError)
    from_s: float = -math.inf
    until_s: float = math.inf
    body_length_m: float = 0.0

    def __post_init__(self) -> None:
        check_body_length(self.body_length_m)


@dataclass(frozen=True)
class Pulsation:
    """Sinusoid of random phase in the ambient field, the same at all sensors."""

    amplitude_T: Vector  # (3,): world frame
    period_s: float


@dataclass(frozen=True)
class Platform:
    r"""Noise of the platform that carries the array.

    Attributes
    ----------
    position_m, moment_Am2 : tuple, shape (3,)
        A dipole fixed to the array, array frame.
    frequency_Hz : float
        It oscillates as :math:`\cos(2π f t + φ)` with a random φ; 0 = it is constant.
    noise_T : float
        White noise per axis and sample in the array's frame, the same at all sensors.
    induced, eddy_s : float
        Standard deviation of each component (3, 3), at each sensor, of the field induced in the platform, per ambient
        field, and per its derivative in the array's axes. The nominal array states them.
    """

    position_m: Vector = _ZERO
    moment_Am2: Vector = _ZERO
    frequency_Hz: float = 0.0
    noise_T: float = 0.0
    induced: float = 0.0
    eddy_s: float = 0.0


@dataclass(frozen=True)
class Missing:
    """Missing readings.

    Attributes
    ----------
    dropout : float
        Probability that a sensor misses a sample, all its axes together.
    gaps_s : tuple of pairs
        Begin and end of each span without rows.
    """

    dropout: float = 0.0
    gaps_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class MagneticScenario:
    """Everything that a simulation needs except its seed.

    Attributes
    ----------
    array : SensorArray
        Positions of the sensors, and their known calibration. The models state noise, limits and uncertainties.
    models : tuple of SensorModel
        Model of each sensor.
    duration_s, rate_Hz : float
        Rows are at 0, 1/rate, 2/rate, … up to and including the duration.
    carrier : Carrier
        Motion of the array.
    sources : tuple of Source
        Sources; an empty tuple for a recording of noise.
    ambient_T : tuple, shape (3,), optional
        Geomagnetic field, world frame. None: no field, and no columns for it in the readings.
    pulsations : tuple of Pulsation
        Sinusoids in the ambient field.
    platform : Platform
        Noise of the platform that carries the array.
    missing : Missing
        Missing readings.
    pose : PoseUncertainty, optional
        Errors of the pose in the readings. The nominal array states them too, unless `array` states others.
    targets : Targets, optional
        Targets at random positions in the ground, in addition to the sources.
    geology : Geology, optional
        Field of the ground.
    name : str

    Raises
    ------
    ValueError
        The models do not fit the sensors of the array, or the times are not positive and finite or give more than five
        million rows.

    Examples
    --------
    >>> import sims
    >>> scenario = sims.read_scenario("weaving")
    >>> scenario.array.n_sensors, scenario.rate_Hz
    (4, 2.0)
    """

    array: SensorArray
    models: tuple[SensorModel, ...]
    duration_s: float
    rate_Hz: float
    carrier: Carrier = field(default_factory=Carrier)
    sources: tuple[Source, ...] = ()
    ambient_T: Vector | None = None
    pulsations: tuple[Pulsation, ...] = ()
    platform: Platform = field(default_factory=Platform)
    missing: Missing = field(default_factory=Missing)
    pose: PoseUncertainty | None = None
    targets: Targets | None = None
    geology: Geology | None = None
    name: str = ""

    def __post_init__(self) -> None:
        check_positive(duration_s=self.duration_s, rate_Hz=self.rate_Hz)
        if self.duration_s * self.rate_Hz >= MOST_ROWS:
            raise ValueError(
                f"Inputs duration_s and rate_Hz must give at most {MOST_ROWS} rows; "
                f"instead received {self.duration_s:g} s at {self.rate_Hz:g} Hz."
            )
        if len(self.models) != self.array.n_sensors:
            raise ValueError(
                f"Input models must be one for each of the {self.array.n_sensors} sensors; "
                f"instead received {len(self.models)}."
            )
        for sensor, model in zip(self.array.sensors, self.models, strict=True):
            if sensor.kind != model.reads:
                raise ValueError(
                    f"Input models must be of the kinds of the sensors; instead received a {model.reads} model "
                    f"for the {sensor.kind} sensor {sensor.id!r}."
                )

    @property
    def time_s(self) -> FloatArray:
        """Instants of all samples, including gaps, shape (n,) [s]."""
        # A rounded product must not lose the last row: 0.1 s at 30 Hz are 3 periods.
        return np.arange(math.floor(self.duration_s * self.rate_Hz * (1.0 + 1e-12)) + 1) / self.rate_Hz

    @property
    def nominal_array(self) -> SensorArray:
        """The array as its user knows it."""
        array = nominal_array(self.array, self.models, self.rate_Hz)
        induced, eddy_s = self.platform.induced, self.platform.eddy_s
        sensors = [replace(sensor, induced_uncertainty=induced, eddy_uncertainty_s=eddy_s) for sensor in array.sensors]
        array = replace(array, sensors=tuple(sensors))
        return array if array.pose is not None else replace(array, pose=self.pose)
