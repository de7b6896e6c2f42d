"""What is known of several sources at one instant."""

from __future__ import annotations

from dataclasses import dataclass

from arrays.typing import FloatArray
from magloc.tracking.results import TrackPoint


@dataclass(frozen=True, eq=False)
class SourcePoint(TrackPoint):
    """One of several sources at one instant.

    Attributes
    ----------
    id : int
        The same in all rows.
    merged : bool
        Whether it is so near to another that their gap is less certain than a third of it: which is which is then a
        guess, and so are the places.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    id: int = 0
    merged: bool = False


@dataclass(frozen=True, eq=False)
class SourcesPoint:
    """All sources at one instant.

    Attributes
    ----------
    time_s : float
    tracks : tuple of SourcePoint
        In the order of their ids.
    status : str
        "tracked", "no source", "no readings", "misfit": no sources, losses and faults explain the readings, and the
        tracks are predictions; or "doubtful": χ² of the last rows together is beyond noise, and what is wrong is being
        looked for.
    chi2 : float
        Of the row given its prediction.
    dof : int
        Number of its readings.
    dropped_sensors : tuple of str
        Sensors that are left out.
    """

    time_s: float
    tracks: tuple[SourcePoint, ...]
    status: str
    chi2: float
    dof: int
    dropped_sensors: tuple[str, ...] = ()
