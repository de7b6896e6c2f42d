"""``magloc track`` with ``--position`` or ``--object-path``: the moment through time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from arrays.io.errors import LARGEST, InputError
from magloc.cli.framework import note, print_json, print_report, refuse_outside
from magloc.cli.options import KnownOptions, MapOptions

if TYPE_CHECKING:
    from arrays.typing import BoolArray
    from magloc.signature.moment_track import MomentTrack
    from magloc.signature.path import PathError
    from magloc.tracking.results import TrackPoint


@dataclass(frozen=True)
class TrackOutputs:
    """Outputs of a track; see :func:`magloc.cli.track.track`."""

    json: bool
    jsonl: bool
    maps: MapOptions
    out: Path | None
    truth: Path | None


def refuse_bounds(known: KnownOptions) -> None:
    """Refuse bounds of the source where its position is known."""
    for option, value in (("--region", known.region), ("--max-moment-Am2", known.max_moment_Am2)):
        if value is not None:
            raise InputError(f"{option}: found together with a known position, expected no bounds of the source.")


@Parameter(name="*", group="Error of the known path")
@dataclass(frozen=True)
class PathErrorOptions:
    """Errors of a known path.

    Parameters
    ----------
    path_sigma_m : float
        Standard deviation of the position along each axis [m].
    path_correlation_s : float
        Correlation time of that error [s]: 0 for a new error in every row; by default constant over the path.
    attitude_sigma_deg : float
        Standard deviation of the attitude about each axis [°].
    attitude_correlation_s : float
        Correlation time of that error [s], such as 1 for an unknown roll; by default constant over the path.
    """

    path_sigma_m: float = 0.0
    path_correlation_s: float | None = None
    attitude_sigma_deg: float = 0.0
    attitude_correlation_s: float | None = None

    def path_error(self) -> PathError:
        """Return the errors that the options state."""
        from magloc.signature.path import PathError

        refuse_outside(0.0, LARGEST, "a number that is not negative", **asdict(self))
        for sigma, correlation in (
            ("path-sigma-m", "path-correlation-s"),
            ("attitude-sigma-deg", "attitude-correlation-s"),
        ):
            if getattr(self, correlation.replace("-", "_")) is not None and not getattr(self, sigma.replace("-", "_")):
                raise InputError(f"--{correlation}: found no --{sigma}, expected both.")
        return PathError(
            self.path_sigma_m,
            math.inf if self.path_correlation_s is None else self.path_correlation_s,
            math.radians(self.attitude_sigma_deg),
            math.inf if self.attitude_correlation_s is None else self.attitude_correlation_s,
        )


def write_moment_tracks(
    found: Sequence[MomentTrack], readings: Path, known: KnownOptions, outputs: TrackOutputs
) -> None:
    """Print the moments of one source or of several, and write the outputs."""
    import numpy as np

    import magloc
    from magloc.tracking.files import json_entry

    first, several = found[0], len(found) > 1
    for option, value in {**outputs.maps.outputs, "--truth": outputs.truth, "--out": outputs.out}.items():
        if several and value is not None:
            raise InputError(f"{option}: found several places of --position, expected one.")
    result = None if outputs.truth is None else first.consistency(magloc.read_truth(outputs.truth))
    outputs.maps.write(first, known.place)
    if outputs.out is not None:
        from magloc.plots.tracks import write_track_figures

        write_track_figures(first, None, outputs.out, array_m=first.readings.array_position_m)
    entries = [_entry_of_several(points) if several else json_entry(points[0]) for points in zip(*found, strict=True)]
    if outputs.json:
        report = {"results": entries, "chi2": first.chi2, "dof": first.dof, "misfit": first.misfit}
        print_report(report if result is None else report | {"consistency": asdict(result)})
    elif outputs.jsonl:
        for entry in entries:
            print_json(entry)
    else:
        tables = [f"source {k}\n{track.table()}" for k, track in enumerate(found, start=1)]
        print("\n".join(tables) if several else first.table())
    if result is not None and not outputs.json:
        print_consistency(result.lines(), jsonl=outputs.jsonl)
    _note(first, np.all([track.tracked for track in found], axis=0), readings, outputs)


def _entry_of_several(points: Sequence[TrackPoint]) -> dict[str, object]:
    """Return the JSON entry of one row of several sources."""
    from magloc.localization.fit.results import values_of

    sources = [values_of(point, ("position_m", "moment_Am2", "covariance")) for point in points]
    return values_of(points[0], ("time_s", "nis", "nis_dof", "status")) | {"sources": sources}


def _note(found: MomentTrack, determined: BoolArray, readings: Path, outputs: TrackOutputs) -> None:
    """Print notes on the fit, and refuse readings that determine nothing."""
    if found.misfit:
        note(
            f"misfit: χ² {found.chi2:.0f} of {found.dof}; no dipole on this path explains the readings (path,"
            " clock, another source, a body too near, or a stated noise that is too small)"
        )
    if not (outputs.json or outputs.jsonl):
        note(f"{determined.sum()} of {len(found)} rows with a moment")
    if not determined.any():
        raise InputError(f"{readings}: found no row that determines the moment, expected rows nearer to the object.")


def print_consistency(lines: Iterable[str], *, jsonl: bool) -> None:
    """Print the consistency of a track below its table, or on stderr beside its JSON lines."""
    for line in lines:
        note(line, always=True) if jsonl else print(line)
