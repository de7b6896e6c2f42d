"""``magloc signature``: permanent and induced moment of a ship on known courses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import magloc
from arrays.io.errors import LARGEST, InputError, naming
from magloc.cli.framework import ABOVE_ZERO, CommonOptions, Flag, note, print_result, refuse_outside
from magloc.cli.moments.known_path import PathErrorOptions, refuse_bounds
from magloc.cli.options import KnownOptions, ambient_field

if TYPE_CHECKING:
    from magloc.readings import Readings


def signature(
    *readings: Path,
    array: Path,
    object_path: Annotated[list[Path], Parameter(consume_multiple=True)],
    induced: Literal["diagonal", "symmetric", "none"] = "diagonal",
    eddy: Flag = False,
    depth_m: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    json: Flag = False,
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    error: PathErrorOptions = PathErrorOptions(),  # noqa: B008 - frozen
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Separate the permanent and the induced moment of a ship that passes on known courses.

    In the ship's axes forward, left, up (x, y, z) the moment is the sum of a permanent moment, of the moment that the
    ambient field induces, and of a moment of eddy currents while the ship turns. The command names the parts that the
    headings do not separate, and warns of readings that the model does not explain.

    Parameters
    ----------
    readings : Path
        Readings files (CSV), one for every pass, of one clock and in order of time; or one file of all passes.
    array : Path
        Array file (TOML). The constant errors of the sensors that it states are estimated too.
    object_path : list of Path
        Path file (CSV) of every pass, or one for all: time_s,x_m,y_m,z_m and optionally the attitude qx,qy,qz,qw, from
        the ship's axes to the frame of the results. Without an attitude the ship is level, with its bow along the
        course.
    induced : {"diagonal", "symmetric", "none"}
        Components of the polarisability to estimate.
    eddy : bool
        Estimate eddy currents too; needs passes on which the ship turns or rolls.
    depth_m : list of float
        Depths below the path [m] at which to predict the field along the keel, on four headings.
    json : bool
        Print one JSON object instead of the table.
    known : KnownOptions
        Prior knowledge of the sensors and of the ambient field.
    error : PathErrorOptions
        Errors of the paths.
    common : CommonOptions
        Common options.
    """
    from magloc.signature.files import json_of_signature, lines_of_depths

    if not readings:
        raise InputError("READINGS is missing.")
    if len(object_path) not in (1, len(readings)):
        raise InputError(
            f"--object-path: found {len(object_path)} files, expected one, or {len(readings)} as READINGS."
        )
    depths = depth_m or []
    for depth in depths:
        refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", depth_m=depth)
    refuse_bounds(known)
    nominal, used = known.array(array), None
    passes: list[Readings] = []
    for path in readings:
        rows = magloc.read_readings(path, nominal, sensors=known.ids, ordered=True)
        used, ambient_T = ambient_field(nominal, rows, known.where)
        if ambient_T is None and used.ambient_T is None and (eddy or induced != "none"):
            raise InputError(
                f"{path}: found no ambient field, expected columns ambient_x_nT and so on, ambient_nT in the array"
                " file, --place and --date, or --induced none."
            )
        passes.append(replace(rows, ambient_T=ambient_T))
    paths = [magloc.read_object_path(path) for path in object_path]
    names = ", ".join(map(str, readings))
    with naming(str(array), readings=names, time_s=names, path=", ".join(map(str, object_path))):
        result = magloc.fit_signature(
            used or nominal,
            passes,
            paths if len(paths) > 1 else paths[0],
            induced=induced,
            eddy=eddy,
            path_error=error.path_error(),
        )
    lines = [*result.table().splitlines(), *lines_of_depths(result, depths)]
    print_result(json_of_signature(result, depths), lines, as_json=json)
    if result.misfit:
        note(
            f"misfit: χ² {result.chi2:.0f} of {result.dof}; no such moment on these paths explains the readings (path,"
            " attitude, clock, another source, a body too near, or a stated noise that is too small)"
        )
