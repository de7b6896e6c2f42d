"""Known paths and attitudes of objects, and their files.

A path file is CSV with ``time_s, x_m, y_m, z_m[, qx, qy, qz, qw]``, one row per instant, in the frame of the results:
the world's if the readings have the array's pose, otherwise the array's. The quaternion (scalar last) turns from the
object's axes (forward, left, up) to that frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.csv import read_table
from arrays.io.errors import InputError
from arrays.io.text import write_text
from arrays.typing import FloatArray
from magloc.navigation.poses import rotations_at, unit_rotation
from magloc.readings import Readings
from magloc.truth import TRUE_POSITION_COLUMNS, TRUE_ROTATION_COLUMNS, Truth, truth_of_rows

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SLOWEST_M_S = 1e-3
_EXPECTED = "a header with time_s, x_m, y_m and z_m"


@dataclass(frozen=True, eq=False)
class ObjectPath:
    """Known path of an object.

    Attributes
    ----------
    time_s : ndarray, shape (k,)
        Instants [s], of the readings' clock.
    position_m : ndarray, shape (k, 3)
        Positions [m], in the frame of the results.
    rotation : Rotation of k, optional
        From the object's axes (forward, left, up) to that frame.
    name : str
        Name in error messages: the file of the path.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> path = magloc.ObjectPath(np.array([0.0, 10.0]), np.array([[-20.0, 0.0, 18.0], [20.0, 0.0, 18.0]]))
    >>> path.at(np.array([5.0, 11.0]))[0]
    array([[ 0.,  0., 18.],
           [nan, nan, nan]])
    """

    time_s: FloatArray
    position_m: FloatArray
    rotation: Rotation | None = None
    name: str = "path"

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return positions (n, 3) at some instants, and rotations (n, 3, 3) if known.

        Between the rows of the path positions run straight and attitudes turn evenly; outside them, and in gaps,
        positions are NaN.

        Raises
        ------
        InputError
            The path has none of the instants.
        """
        wanted = Readings(np.empty((len(time_s), 0)), time_s=time_s)
        position = truth_of_rows(wanted, Truth(self.time_s, self.position_m, name=self.name)).position_m
        if self.rotation is None:
            return position, None
        return position, rotations_at(time_s, self.time_s, self.rotation).as_matrix()

    def along_course(self) -> ObjectPath:
        """Return the path with an attitude; by default level, the bow along the course.

        Raises
        ------
        InputError
            The path has no attitude and does not move.
        """
        if self.rotation is not None:
            return self
        from scipy.spatial.transform import Rotation

        order = np.argsort(self.time_s, kind="stable")
        velocity: FloatArray = np.zeros((len(order), 3))
        if len(order) > 1:
            velocity = np.asarray(np.gradient(self.position_m[order], self.time_s[order], axis=0))
        moves = np.hypot(velocity[:, 0], velocity[:, 1]) > _SLOWEST_M_S
        if not moves.any():
            raise InputError(
                f"{self.name}: found neither an attitude nor a horizontal velocity, expected columns qx, qy, qz, qw."
            )
        # At rest the bow keeps its heading; before the first movement it has the heading of that movement.
        last = np.maximum.accumulate(np.where(moves, np.arange(len(order)), -1))
        yaw = np.arctan2(velocity[:, 1], velocity[:, 0])[np.where(last >= 0, last, np.argmax(moves))]
        back = np.argsort(order, kind="stable")
        return ObjectPath(self.time_s, self.position_m, Rotation.from_euler("z", yaw[back, None]), self.name)


@dataclass(frozen=True)
class PathError:
    """Uncertainty of a path: first-order Markov processes along and about each axis.

    Attributes
    ----------
    position_m : float
        Standard deviation of the position; 0 if it is exact.
    position_correlation_s : float
        Correlation time of its error: infinite for a constant offset, 0 for independent rows.
    attitude_rad, attitude_correlation_s : float
        The same for small rotations about the axes of the frame of the results.

    Examples
    --------
    >>> import magloc
    >>> magloc.PathError(position_m=2.0, attitude_rad=0.05, attitude_correlation_s=5.0).position_correlation_s
    inf
    """

    position_m: float = 0.0
    position_correlation_s: float = math.inf
    attitude_rad: float = 0.0
    attitude_correlation_s: float = math.inf

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the error's states: (0,), (3,) or (6,)."""
        return np.repeat([sigma for sigma in (self.position_m, self.attitude_rad) if sigma], 3)

    def kept(self, dt_s: float) -> FloatArray:
        """Return the share of each error that remains after a step."""
        processes = (
            (self.position_m, self.position_correlation_s),
            (self.attitude_rad, self.attitude_correlation_s),
        )
        shares = [math.exp(-dt_s / time) if time else 0.0 for sigma, time in processes if sigma]
        return np.repeat(np.array(shares), 3)


def read_object_path(path: str | PathLike[str]) -> ObjectPath:
    r"""Read a known path from a CSV file.

    Parameters
    ----------
    path : str or path-like
        A path file (CSV): ``time_s,x_m,y_m,z_m``, and ``qx,qy,qz,qw`` where the attitude is known.

    Returns
    -------
    ObjectPath
        Path with positions [m], and rotations if the file has attitudes.

    Raises
    ------
    InputError
        The file cannot be read, or is not a path file.

    Examples
    --------
    >>> from pathlib import Path
    >>> import magloc
    >>> _ = Path("path.csv").write_text("time_s,x_m,y_m,z_m\n0,-20,0,18\n10,20,0,18\n")
    >>> magloc.read_object_path("path.csv").position_m.shape
    (2, 3)
    """
    table = read_table(path, _EXPECTED)
    known = ("time_s", *TRUE_POSITION_COLUMNS, *TRUE_ROTATION_COLUMNS)
    for name in known[:4]:
        table.require(name, known)
    table.refuse_unknown(known)
    time_s = table.times()
    rotation = unit_rotation(table, TRUE_ROTATION_COLUMNS) if table.has_group(TRUE_ROTATION_COLUMNS) else None
    return ObjectPath(time_s, table.complete(TRUE_POSITION_COLUMNS), rotation, str(path))


def write_object_path(path: str | PathLike[str], known: ObjectPath) -> None:
    """Write a path file at full precision."""
    header = ["time_s", *TRUE_POSITION_COLUMNS]
    columns = [known.time_s[:, None], known.position_m]
    if known.rotation is not None:
        header += TRUE_ROTATION_COLUMNS
        columns.append(known.rotation.as_quat())
    rows = (",".join(map(repr, row)) for row in np.hstack(columns).tolist())
    write_text("\n".join([",".join(header), *rows, ""]), path)
