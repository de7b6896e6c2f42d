"""``magloc locate``: one fix for every row of a readings file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

import magloc
from arrays.io.errors import LARGEST, InputError, own_sentence
from arrays.io.outputs import refuse_file
from arrays.typing import Vector
from magloc.cli.framework import CommonOptions, Flag, note, print_json_list, progress, refuse_outside, warn
from magloc.cli.moments.magnet import MagnetOptions
from magloc.cli.options import KnownOptions, ambient_field, number_of_sources

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.localization.fit.fixes import Fixes
    from magloc.readings import Readings

# Largest distance of a known position from the array, per axis: no field from there can be measured.
_FARTHEST_M = 1e6


@Parameter(name="*", group="Fixes")
@dataclass(frozen=True)
class FixOptions:
    """Sources to estimate in every row.

    Parameters
    ----------
    sources : str
        Number of sources in every row, or "auto" for as many as the readings support, at most five. 1 by default.
    position : tuple of 3 floats
        Known position of the source [m], in the frame of the results; only its moment is estimated. Give it several
        times for several sources.
    average : bool
        Average all rows to one fix. The array and the source must not move.
    ambient_gradient : bool
        Also model the gradient of the geomagnetic field (tens of pT/m); needs --place.
    body_length_m : float
        Length of the object [m]. The part of its field that a dipole does not describe counts as noise, and fixes
        nearer than three lengths are flagged. By default a quarter of its distance, if four sensors are nearer than 0.6
        of the array's circumradius. 0 for a point source.
    keep_sensors : bool
        Use all sensors, even those that contradict the others.
    magnet : MagnetOptions
        Shape of a magnet.
    body : Path
        Body file (TOML) of a rigid body of two or more magnets; its pose is estimated, in the array's frame.
    """

    sources: str | None = None
    position: list[Vector] | None = None
    average: Flag = False
    ambient_gradient: Flag = False
    body_length_m: float | None = None
    keep_sensors: Flag = False
    magnet: MagnetOptions = field(default_factory=MagnetOptions)
    body: Path | None = None

    @property
    def n_sources(self) -> int | Literal["auto"]:
        """Number of sources to estimate."""
        return 1 if self.sources is None else number_of_sources(self.sources)


def locate(
    readings: Path,
    /,
    *,
    array: Path,
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    wanted: FixOptions = FixOptions(),
    truth: Path | None = None,
    out: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Locate the sources in every row of a readings file, each row on its own.

    Positions are in the array's frame, or in the world frame if the readings have the array's pose. The table has the
    best solution of every row: s is the standard deviation; range95 is the 95 % set of distances from the sensors'
    centroid, over all solutions. Flags: "weak" = no source stands out of the noise, the range may be anything (noise
    alone looks like a source in one of a thousand rows); "range?" = the range is not observable, s is as long as
    range95; "bent" = the likelihood is not Gaussian, trust range95 rather than s; "+2(70%)" = two other solutions fit
    almost as well, the best one has 70 % of the probability, see --json; "-s3" = sensor s3 contradicts all others and
    is not used; "merged" = two sources that the array cannot separate; "near" = too near for a dipole; "misfit" = χ² is
    far beyond noise.

    Parameters
    ----------
    readings : Path
        Readings file (CSV).
    array : Path
        Array file (TOML).
    known : KnownOptions
        Prior knowledge of the sensors, of the source and of the ambient field.
    wanted : FixOptions
        Sources to estimate in every row.
    truth : Path
        Truth file (CSV). The figures of --out show it, with the errors.
    out : Path
        Folder for figures and their data: fixes with 95 % ellipses, standard deviations, χ² with its bounds, and the
        residuals of every sensor.
    json : bool
        Print one JSON object with all solutions, instead of the table.
    common : CommonOptions
        Common options.
    """
    from magloc.localization.files import entries_of_fixes
    from magloc.localization.fit.table import legend, lines_of_fixes
    from magloc.localization.locator import used_rows
    from magloc.truth import cause_of_disagreement, truth_of_rows

    where, prior, n_sources = known.where, known.prior, wanted.n_sources
    length_m, position = wanted.body_length_m, wanted.position
    if wanted.body is not None:
        from magloc.cli.moments.body_poses import locate_with_body, refuse_with_body

        single = {"--sources": wanted.sources, "--position": position, "--body-length-m": length_m, "--truth": truth}
        single |= {"--magnet": wanted.magnet.kind}
        refuse_with_body(single | {"--average": wanted.average, "--ambient-gradient": wanted.ambient_gradient})
        refuse_file(out, "--out")
        locate_with_body(readings, array, wanted.body, known, as_json=json, out=out)
        return
    joint = wanted.sources is not None or (position is not None and len(position) > 1)
    magnet = wanted.magnet.shape(position=position, body_length_m=length_m)
    refuse_outside(0.0, LARGEST, "a length, or 0 for a point", body_length_m=length_m)
    if position is not None and (wanted.sources is not None or known.region is not None):
        other = "--sources" if wanted.sources is not None else "--region"
        raise InputError(f"--position: found together with {other}, expected one of them.")
    if truth is not None and out is None:
        raise InputError("--truth: found no --out, expected a folder for the figures with it.")
    refuse_file(out, "--out")
    used = known.array(array)
    rows = magloc.read_readings(readings, used, sensors=known.ids, still=wanted.average)
    if position is not None:
        _refuse_farther(position, rows)
    used, ambient_T = ambient_field(used, rows, where, gradient=wanted.ambient_gradient)
    try:
        pictured, noisy, _ = used_rows(rows, used, average=wanted.average)
        stated = None if truth is None else magloc.read_truth(truth)
        true = None if stated is None else truth_of_rows(pictured, stated)
        with progress(len(rows), "rows") as advance:
            fixes = magloc.locate(
                used,
                rows,
                sources=n_sources,
                position_m=position,
                prior=prior,
                ambient_T=ambient_T,
                body_length_m=length_m,
                magnet=magnet,
                exclude_faulty=not wanted.keep_sensors,
                average=wanted.average,
                rng=common.seed,
                progress=advance,
            )
    except InputError as error:
        raise InputError(f"{readings}: {error}") from None
    except ValueError as error:
        sentence = own_sentence(error)
        option = "" if sentence.startswith("array") else _option_of(sentence, known.region, wanted.sources)
        place = readings if sentence.startswith("readings") else array
        raise InputError(f"{option or place}: {sentence}{_advice(sentence, used)}") from None

    if json:
        print_json_list("results", entries_of_fixes(fixes, joint=joint))
    else:
        lines = lines_of_fixes(fixes, joint=joint)
        print("\n".join(lines))
    reasons = count_reasons(reason for reason, solved in zip(fixes.reason, fixes.solved, strict=True) if not solved)
    n_solved = int(fixes.solved.sum())
    if not n_solved:
        raise InputError(f"{readings}: found no row that can be solved ({reasons}).")
    if stated is not None and n_sources == 1 and position is None:
        warn(filter(None, [cause_of_disagreement(stated, fixes.time_s, fixes.position_m)]))
    if out is not None:
        from magloc.plots.localization import write_fix_figures

        write_fix_figures(pictured, noisy, fixes, ambient_T, None if true is None else true.position_m, out)
    if not json:
        note(f"{n_solved} of {len(fixes)} rows solved" + (f"; not solved: {reasons}" if reasons else ""))
    for line in [*_notes(fixes, assumed=length_m is None), *([] if json else legend(lines))]:
        note(line)
    if n_sources == 1 and position is None and rows.pose is None:
        from magloc.localization.subtracted_background import background_is_subtracted

        if background_is_subtracted(noisy, pictured.values_T[fixes.solved & fixes.detected]):
            note(
                "hint: the field common to all sensors is small, as after a background was subtracted; fixes are more"
                ' accurate with background = "subtracted" in the array file'
            )


def _refuse_farther(positions: list[Vector], rows: Readings) -> None:
    """Refuse a position that is too far from the array in some row."""
    import numpy as np

    array_m = np.zeros(3) if rows.array_position_m is None else rows.array_position_m
    farthest = float(np.abs(np.array(positions)[:, None] - array_m).max())
    if farthest > _FARTHEST_M:
        raise InputError(
            f"--position: found a place {farthest:g} m from the array, expected one within {_FARTHEST_M:g} m."
        )


def _option_of(sentence: str, region: str | None, sources: str | None) -> str:
    """Return the option that an error of the library is about."""
    if sentence.startswith(("n_sources", "sources")):
        return f"--sources {sources}"
    if sentence.startswith("position_m"):
        return "--position"
    return f"--region {region}" if sentence.startswith("prior") and region is not None else ""


def _advice(sentence: str, array: SensorArray) -> str:
    if sentence.startswith("array must give") and array.channel_is_scalar.any():
        return " Add sensors, or state the position of the source with --position."
    return ""


def _notes(fixes: Fixes, *, assumed: bool) -> Iterator[str]:
    """Yield notes on faulty sensors and on doubtful fixes."""
    n = len(fixes)
    dropped = Counter(name for names in fixes.dropped_sensors for name in names)
    if dropped:
        yield f"warning: sensors that contradict all others are not used: {_rows_of(dropped)}"
    fewer = Counter(reason for reason, solved in zip(fixes.reason, fixes.solved, strict=True) if solved and reason)
    for reason, count in fewer.most_common():
        yield f"note: in {count} of {n} rows {reason}"
    if fixes.misfit.any():
        yield (
            f"warning: in {fixes.misfit.sum()} of {n} rows χ² is far beyond noise: the stated noise is too small or"
            " the model does not hold; the standard deviations, enlarged by √(χ²/dof), are rough"
        )
    weak = fixes.solved & ~fixes.detected
    if weak.any():
        yield (
            f"note: in {weak.sum()} of {n} rows nothing stands out of the noise: their solutions fit noise, and a"
            " source may be at any range"
        )
    lost = Counter(name for names in fixes.saturated_channels for name in names)
    if lost:
        yield f"warning: saturated readings are not used: {_rows_of(lost)}"
    bodies = fixes.body_length_m > 0.0
    if assumed and bodies.any():
        yield (
            f"note: in {bodies.sum()} of {n} rows the source is so near that its size matters: a length of a quarter of"
            " its distance is assumed; set --body-length-m, 0 for a point source"
        )
    if fixes.caution:
        yield f"note: {fixes.caution} with --body-length-m, 0 for a point"
    if fixes.too_near.any():
        yield (
            f"warning: in {fixes.too_near.sum()} of {n} rows the source is too near, or too large, for a dipole: the"
            " residuals have the pattern of an extended source, or it is nearer than three body lengths"
        )


def _rows_of(counts: Counter[str]) -> str:
    return ", ".join(f"{name} ({n} row{'s' if n > 1 else ''})" for name, n in counts.most_common())


def count_reasons(reasons: Iterable[str], most: int = 3) -> str:
    """Return reasons with their numbers of rows, the commonest first."""
    counts = Counter(reasons).most_common()
    others = sum(n for _, n in counts[most:])
    parts = counts[:most] + [("other reasons", others)] * (others > 0)
    return "; ".join(f"{n} row{'s' if n > 1 else ''}: {reason}" for reason, n in parts)
