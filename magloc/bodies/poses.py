"""Poses of a body in rows of readings, as results: arrays, table and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.io.csv import Column
from arrays.io.results import Result
from arrays.typing import FloatArray, IntArray
from magloc.chi_square import exceeds
from magloc.levels import MISFIT

FLAGS = {
    "missing": "this magnet gives no field: the readings agree with the body without it",
    "sensor": "this sensor contradicts all others and is not used",
    "misfit": "χ² is far beyond noise; standard deviations are enlarged by √(χ²/dof)",
    "bent": "the likelihood is not Gaussian: errors may be larger than the covariance says",
    "unknown": "the readings leave a rotation or a translation open",
}
"""Flags of a pose, and what they mean."""


_LARGEST_BEND = 0.3  # beyond it the mean NEES of simulated rows is 2


@dataclass(frozen=True, eq=False)
class BodyPoses(Result):
    """Poses of a body, best first, in n rows of W places; NaN where there is none.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    position_m : ndarray, shape (n, W, 3)
        Position of the body's origin in the array's frame [m].
    R : ndarray, shape (n, W, 3, 3)
        Rotation from the body's frame to the array's.
    covariance : ndarray, shape (n, W, 6, 6)
        Covariance of (δx [m], δθ [rad]), δθ in the body's frame.
    chi2 : ndarray, shape (n, W)
    dof : ndarray of int, shape (n,)
        Differences minus unknowns; all 6 unknowns, or 5 if a rotation about an axis has no effect.
    flags : list of tuple of str
        Flags of each row, with the name of the magnet or sensor: "missing m2", "sensor s3", "misfit", "unknown".
    reason : list of str
        Why a row has no pose; empty for rows that have one.
    symmetry : str
        Sentence about the symmetry of the body; empty without one.
    """

    time_s: FloatArray
    position_m: FloatArray
    R: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    dof: IntArray
    flags: list[tuple[str, ...]]
    reason: list[str]
    symmetry: str = ""

    figure = "magloc.plots.tracks:plot_poses"
    command = "magloc locate --body"

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice) -> Self:
        """Return some rows."""
        of_rows = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "symmetry"}
        return replace(self, **{name: values[rows] for name, values in of_rows.items()})

    @property
    def solved(self) -> np.ndarray:
        """Rows that have a pose (n,)."""
        return np.isfinite(self.chi2[:, 0])

    @property
    def n_poses(self) -> IntArray:
        """Number of poses of every row (n,)."""
        return np.isfinite(self.chi2).sum(axis=1)

    @property
    def rotation(self) -> Rotation:
        """Rotations of the best poses (n,), the identity where there is none."""
        return Rotation.from_matrix(np.where(self.solved[:, None, None], self.R[:, 0], np.eye(3)))

    @property
    def frame(self) -> str:
        """Frame of the poses."""
        return "array"

    @classmethod
    def none(cls, n: int, width: int, symmetry: str = "") -> BodyPoses:
        """Return n rows without a pose."""
        return cls(
            np.arange(n, dtype=np.float64),
            np.full((n, width, 3), np.nan),
            np.full((n, width, 3, 3), np.nan),
            np.full((n, width, 6, 6), np.nan),
            np.full((n, width), np.nan),
            np.zeros(n, dtype=np.intp),
            [()] * n,
            [""] * n,
            symmetry,
        )

    def put(self, rows: IntArray, others: BodyPoses) -> None:
        """Write the poses of other rows into these rows."""
        for field in fields(self):
            values, of_others = getattr(self, field.name), getattr(others, field.name)
            if field.name in ("flags", "reason"):
                for row, value in zip(rows.tolist(), of_others, strict=True):
                    values[row] = value
            elif field.name not in ("time_s", "symmetry"):
                values[rows] = of_others

    def columns(self) -> dict[str, Column]:
        """Return the columns of the CSV file."""
        xyzw = np.where(self.solved[:, None], self.rotation.as_quat(), np.nan)
        sigma = np.sqrt(np.diagonal(self.covariance[:, 0], axis1=1, axis2=2))
        of_rows: dict[str, Column] = {"time_s": self.time_s}
        of_rows |= {f"{axis}_m": self.position_m[:, 0, i] for i, axis in enumerate("xyz")}
        of_rows |= {f"q{axis}": xyzw[:, i] for i, axis in enumerate("xyzw")}
        of_rows |= {f"sigma_{axis}_m": sigma[:, i] for i, axis in enumerate("xyz")}
        of_rows |= {f"sigma_rotation_{axis}_deg": np.degrees(sigma[:, 3 + i]) for i, axis in enumerate("xyz")}
        of_rows |= {"chi2": self.chi2[:, 0], "dof": self.dof, "poses": self.n_poses}
        return of_rows | {"flags": [" ".join(flags) for flags in self.flags], "reason": self.reason}

    def lines(self, most: int | None = None) -> list[str]:
        """Return a header, and a line per row: position and rotation vector with standard deviations."""
        shown = range(len(self))
        if most is not None and len(self) > most:
            shown = [*shown[: most // 2], *shown[-(most // 2) :]]  # type: ignore[assignment]
        turn = np.degrees(self.rotation.as_rotvec())
        sigma = np.sqrt(np.diagonal(self.covariance[:, 0], axis1=1, axis2=2))
        head = ["time_s", "x_mm", "y_mm", "z_mm", "s_mm", "rot_x_deg", "rot_y_deg", "rot_z_deg", "s_deg", "chi2/dof"]
        rows = [[*head, "flags"]]
        for i in shown:
            if not self.solved[i]:
                rows.append([f"{self.time_s[i]:.10g}", f"not solved: {self.reason[i]}"])
                continue
            cells = [*(f"{1e3 * x:.3f}" for x in self.position_m[i, 0]), f"{1e3 * sigma[i, :3].max():.3f}"]
            cells += [*(f"{x:.2f}" for x in turn[i]), f"{np.degrees(sigma[i, 3:].max()):.2f}"]
            others = [f"+{self.n_poses[i] - 1}"] if self.n_poses[i] > 1 else []
            fit = f"{self.chi2[i, 0]:.3g}/{self.dof[i]}"
            rows.append([f"{self.time_s[i]:.10g}", *cells, fit, " ".join([*others, *self.flags[i]])])
        full = [row for row in rows if len(row) == len(rows[0])]
        widths = [max(len(row[i]) for row in full) for i in range(len(head))]
        lines = []
        for row in rows:
            if len(row) == 2:
                lines.append(f"{row[0].rjust(widths[0])}  {row[1]}")
            else:
                aligned = (cell.rjust(width) for cell, width in zip(row, widths, strict=False))
                lines.append("  ".join([*aligned, row[-1]]).rstrip())
        if len(rows) - 1 < len(self):
            lines.insert(1 + (most or 0) // 2, f"… {len(self)} rows")
        return lines

    def entries(self) -> Iterator[dict[str, object]]:
        """Return the results that ``magloc locate --body --json`` prints."""
        for i, time in enumerate(self.time_s.tolist()):
            entry: dict[str, object] = {"time_s": time}
            entry["poses"] = [self._pose(i, k) for k in range(int(self.n_poses[i]))]
            if self.flags[i]:
                entry["flags"] = list(self.flags[i])
            if self.symmetry:
                entry["symmetry"] = self.symmetry
            yield entry | ({"reason": self.reason[i]} if self.reason[i] else {})

    def _pose(self, i: int, k: int) -> dict[str, object]:
        return {
            "position_m": self.position_m[i, k].tolist(),
            "quaternion_xyzw": Rotation.from_matrix(self.R[i, k]).as_quat().tolist(),
            "covariance": self.covariance[i, k].tolist(),
            "chi2": float(self.chi2[i, k]),
            "dof": int(self.dof[i]),
        }


def with_bends(poses: BodyPoses, bend: FloatArray) -> BodyPoses:
    """Return poses with flags of those over whose standard deviation the readings bend too far (n,)."""
    for i in np.flatnonzero(bend > _LARGEST_BEND).tolist():
        poses.flags[i] = (*poses.flags[i], "bent")
    return poses


def with_doubts(poses: BodyPoses) -> BodyPoses:
    """Return poses with flags of doubtful covariances, which are enlarged where χ² is far beyond noise."""
    is_open = poses.solved & ~np.isfinite(poses.covariance[:, 0]).all(axis=(1, 2))
    is_misfit = exceeds(poses.chi2[:, 0], poses.dof, MISFIT)
    for i in np.flatnonzero(is_open).tolist():
        poses.flags[i] = (*poses.flags[i], "unknown")
    for i in np.flatnonzero(is_misfit).tolist():
        poses.flags[i] = (*poses.flags[i], "misfit")
        poses.covariance[i] *= np.maximum(poses.chi2[i] / poses.dof[i], 1.0)[:, None, None]
    return poses
