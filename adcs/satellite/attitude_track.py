"""Attitude over time: the result of a filter for one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from arrays.io.csv import Column
from arrays.io.lazy import by_name
from arrays.io.results import Result
from arrays.typing import BoolArray, FloatArray

_MOST_WARNINGS = 10

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False, repr=False)
class AttitudeTrack(Result):
    """Attitude and further states, as estimated at n instants.

    Attributes
    ----------
    title : str
        Sensors, states and filter in words.
    time_s : ndarray, shape (n,)
        Times of all instants from the first reading of the attitude on, missing rows included.
    rows : ndarray of int
        Indices of the instants of the log.
    q : ndarray, shape (n, 4)
        Attitude, reference frame from body, scalar first; :attr:`rotation` is scipy's form.
    states : mapping of str to ndarray, shape (n, 3)
        ``rate`` against inertial space [rad/s] and the estimated states among ``gyro-bias`` [rad/s], ``field-bias``
        [T], ``disturbance`` [1/s²] and ``dipole`` [A·m²], body axes; ``field-model`` [T], orbital frame; and
        ``field-gain``, nine components.
    used : tuple of str
        Sensors in use.
    seen : mapping of str to ndarray of bool, shape (n,)
        Rows with a reading of each sensor.
    sigma : mapping of str to ndarray, shape (n, 3)
        Standard deviations of the states, in their units, and of ``attitude`` [rad]; empty without a covariance.
    nis : mapping of str to ndarray, shape (n,)
        Normalised innovation squared of each sensor, NaN without a reading: χ² with 3 degrees of freedom, 2 for the Sun
        sensor.
    q_orbital : ndarray, shape (n, 4), optional
        Attitude, orbital frame from body, scalar first.
    warnings : tuple of str
        Sentences on degraded or unobservable states, with durations.
    gated : mapping of str to ndarray of bool, shape (n,)
        Readings of each sensor that the gate rejected; empty for a filter without a gate.
    degraded : mapping of str to ndarray of bool, shape (n,)
        Rows in which readings are of little use, by the reason in words.
    unseen_torque_Nm : mapping of float to float
        Largest unobservable amplitude of a torque by its period [s]; empty if unknown.
    tuned_disturbance_s2 : ndarray, shape (n,), optional
        Standard deviation of the disturbing acceleration, as estimated by the filter ``self-tuning``.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> attitude = adcs.estimate(log.telemetry, log.satellite, sensors="st+gyro")
    >>> attitude.q.shape, sorted(attitude.sigma)
    ((201, 4), ['attitude', 'rate'])
    """

    figure = "adcs.plots.attitude:attitude_figure"
    command = "estimate"

    title: str
    time_s: FloatArray
    rows: NDArray[np.int64]
    q: FloatArray
    states: Mapping[str, FloatArray]
    used: tuple[str, ...]
    seen: Mapping[str, BoolArray]
    sigma: Mapping[str, FloatArray] = field(default_factory=dict)
    nis: Mapping[str, FloatArray] = field(default_factory=dict)
    q_orbital: FloatArray | None = None
    warnings: tuple[str, ...] = ()
    gated: Mapping[str, BoolArray] = field(default_factory=dict)
    degraded: Mapping[str, BoolArray] = field(default_factory=dict)
    unseen_torque_Nm: Mapping[float, float] = field(default_factory=dict)
    tuned_disturbance_s2: FloatArray | None = None

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.time_s)

    @property
    def rotation(self) -> Rotation:
        """Rotation, reference frame from body: inertial (J2000) of :func:`adcs.estimate`, else of the vectors."""
        return quaternion.to_rotation(self.q)

    @property
    def sigma_deg(self) -> FloatArray:
        """Standard deviation of the attitude about the body axes [°], (n, 3); NaN if the filter has none."""
        return np.degrees(self.sigma.get("attitude", np.full((len(self), 3), np.nan)))

    @property
    def rejected(self) -> dict[str, BoolArray]:
        """Masks (n,) of unused readings by sensor: those of sensors not in use, and those that the gate rejected."""
        return {
            name: seen & (self.gated[name] if name in self.gated and name in self.used else name not in self.used)
            for name, seen in self.seen.items()
        }

    @property
    def frame(self) -> str:
        """Name of the frame of ``q``."""
        return "reference" if self.q_orbital is None else "orbital"

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines that ``adcs estimate`` prints, then the warnings.

        Parameters
        ----------
        most : int, optional
            Not used: an attitude track has few lines.

        Returns
        -------
        list of str
            Summary of the track, one line each, then the warnings.
        """
        return [*by_name("adcs.io.estimates:summary_lines")(self), *(f"warning: {text}" for text in self.warnings)]

    def columns(self) -> dict[str, Column]:
        """Return the columns of estimates.csv.

        Returns
        -------
        dict of str to column
            Values of the log's rows by the column's name.
        """
        return by_name("adcs.io.estimates:estimate_columns")(self)


def join_tracks(tracks: Sequence[AttitudeTrack], warning: str) -> AttitudeTrack:
    """Join the tracks of a log's pieces; ``warning`` comes before theirs, of which ten are kept."""
    first = tracks[0]
    before = np.cumsum([0, *(len(track) for track in tracks[:-1])])

    def concatenate(name: str) -> Any:
        values = [getattr(track, name) for track in tracks]
        if isinstance(values[0], Mapping):
            return {key: np.concatenate([one[key] for one in values]) for key in values[0]}
        return None if values[0] is None else np.concatenate(values)

    texts = list(dict.fromkeys(text for track in tracks for text in track.warnings))
    more = (f"and {len(texts) - _MOST_WARNINGS} more like these",) if len(texts) > _MOST_WARNINGS else ()
    arrays = ("time_s", "q", "states", "seen", "sigma", "nis", "q_orbital", "gated", "degraded", "tuned_disturbance_s2")
    return replace(
        first,
        rows=np.concatenate([track.rows + n for track, n in zip(tracks, before, strict=True)]),
        warnings=(warning, *texts[:_MOST_WARNINGS], *more),
        unseen_torque_Nm={key: max(one.unseen_torque_Nm[key] for one in tracks) for key in first.unseen_torque_Nm},
        **{name: concatenate(name) for name in arrays},
    )
