"""Options that several commands share."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from cyclopts import Parameter
from cyclopts.validators import Number

import arrays
import magloc
from arrays.io.errors import LARGEST, InputError, naming, naming_options
from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from arrays.typing import Vector
from magloc.ambient import Place
from magloc.cli import framework
from magloc.cli.framework import ABOVE_ZERO, note, refuse_outside, whole_number

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from arrays.array import SensorArray
    from magloc.live.follower import Follower
    from magloc.localization.fit.prior import SourcePrior
    from magloc.readings import Readings
    from magloc.tracking.motion import MotionModel
    from magloc.tracking.multi_target.motion import FreeMotion
    from magloc.tracking.results import SourcesPoint, TrackPoint


_LOG = logging.getLogger(__name__)
Port = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0, lte=65535))]

STREAM = "-"
"""Name of standard input instead of a file."""


def number_of_sources(sources: str) -> int | Literal["auto"]:
    """Return the number of sources that --sources states."""
    if sources == "auto":
        return "auto"
    try:
        return int(sources)
    except ValueError:
        raise InputError(f"--sources: found {sources!r}, expected a whole number or auto.") from None


def refuse_not_positive(options: object, *names: str, expected: str = "a positive number") -> None:
    """Refuse options, given by their field names, that are not positive and finite."""
    refuse_outside(1.0 / LARGEST, LARGEST, expected, **{name: getattr(options, name) for name in names})


def array_of_several(path: Path, why: str = "") -> SensorArray:
    """Read an array of at least two sensors."""
    array = arrays.read_array(path)
    if array.n_sensors < 2:
        raise InputError(f"{path}: sensors must be at least 2; instead received 1{why and f', {why}'}.")
    return array


Grid = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=2, lte=2000))]
"""Points along an axis. 2000 make 8 billion points, more than a day of computing."""


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_BOUNDS = re.compile(rf"(?:(?P<below>{_NUMBER})<(?=[xyz]<))?(?P<axis>[xyz])(?P<sign>[<>])(?P<bound>{_NUMBER})")


@contextmanager
def naming_outputs() -> Iterator[None]:
    """Turn errors of a viewer into errors about --html, --png, --movie and --port."""
    from magloc.viewer.chromium import BrowserError

    try:
        with naming_options("html", "png", "movie", "port"):
            yield
    except BrowserError as error:
        raise InputError(f"--png: {error}") from None


def ambient_field(
    array: SensorArray, rows: Readings, where: Place | None, *, gradient: bool = False
) -> tuple[SensorArray, NDArray[np.float64] | None]:
    """Return the array with its ambient field, and the field of every row if rows differ."""
    from magloc.ambient import with_ambient_field

    with naming_place():
        return with_ambient_field(array, rows, where, gradient=gradient)


def in_ambient_field(array: SensorArray, rows: Readings, where: Place | None) -> tuple[SensorArray, Readings]:
    """Return the array with its ambient field, and the rows with theirs if rows differ."""
    array, ambient_T = ambient_field(array, rows, where)
    return array, replace(rows, ambient_T=ambient_T)


def naming_place() -> AbstractContextManager[None]:
    """Turn errors of the ambient field into errors about its options."""
    return naming_options("place", "date", "geomagnetic_model", "ambient_gradient")


@Parameter(name="*", group="Motion")
@dataclass(frozen=True)
class MotionOptions:
    """Model of the motion of one source, or of several.

    Parameters
    ----------
    speed_m_s : float
        Typical speed of the source along each axis [m/s].
    turn_deg_s : float
        Typical rate at which the moment turns [°/s]; 5 by default, 100 with --sources.
    motion : {"unknown", "wandering", "turn"}
        unknown: position and moment are random walks; a step is the speed, or the rate, times the interval of two rows.
        wandering: speed and turn rate are estimated too, with the correlation time --correlation-s. turn: a steady turn
        about the vertical. By default unknown.
    correlation_s : float
        Correlation time of the speed, for wandering [s]; by default the time of one turn at the typical rate, 1.5 with
        --sources.
    sources : str
        Track several moving sources in one filter: the largest number of sources, or "auto" for as many as the readings
        support, at most five. Speeds and turn rates are then estimated too. A sensor that fails is excluded and named.
    """

    speed_m_s: float = 0.5
    turn_deg_s: float | None = None
    motion: Literal["unknown", "wandering", "turn"] | None = None
    correlation_s: float | None = None
    sources: str | None = None

    @property
    def number(self) -> int | Literal["auto"] | None:
        """Largest number of sources in one filter; None for the filter of one source."""
        return None if self.sources is None else number_of_sources(self.sources)

    @property
    def turn_rad_s(self) -> float:
        """Typical turn rate of one source."""
        return math.radians(5.0 if self.turn_deg_s is None else self.turn_deg_s)

    def model(self, *, lasting: bool = False) -> MotionModel:
        """Return the motion of one source; by default a random walk, or with `lasting` a speed that lasts."""
        refuse_not_positive(self, "speed_m_s", "turn_deg_s", "correlation_s")
        turn = self.turn_rad_s
        name = self.motion or ("wandering" if lasting else "unknown")
        if name == "unknown":
            return magloc.RandomWalk(self.speed_m_s, turn)
        if name == "wandering":
            return magloc.OrnsteinUhlenbeck(self.speed_m_s, turn, self.correlation_s)
        return magloc.CoordinatedTurn(self.speed_m_s, turn)

    def model_of_several(self) -> FreeMotion:
        """Return the motion of several sources."""
        if self.motion is not None:
            raise InputError(f"--motion: found {self.motion} together with --sources, expected one of them.")
        refuse_not_positive(self, "speed_m_s", "turn_deg_s", "correlation_s")
        turn_rad_s = None if self.turn_deg_s is None else self.turn_rad_s
        given = {"turn_rad_s": turn_rad_s, "correlation_s": self.correlation_s}
        return magloc.FreeMotion(self.speed_m_s, **{name: value for name, value in given.items() if value is not None})

    def follower(
        self, array: SensorArray, known: KnownOptions, place: Place | None = None, rest_s: float = 0.0
    ) -> Follower:
        """Return the tracker of a stream."""
        from magloc.live.follower import Follower

        return Follower(
            array,
            self.model() if self.sources is None else self.model_of_several(),
            sources=self.number,
            prior=known.prior,
            sensors=known.ids,
            place=place,
            rest_s=rest_s,
        )

    def print_entry(self, point: TrackPoint | SourcesPoint, **more: float) -> None:
        """Print the JSON line of a row at once."""
        from magloc.tracking.files import json_entry

        framework.print_json(json_entry(getattr(point, "sources", None) or point, single=self.number == 1) | more)
        sys.stdout.flush()


_SAME_deg = 1e-6  # between places that count as one, a tenth of a metre
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}(T\d{2}:\d{2}(:\d{2}(\.\d+)?)?)?")


@Parameter(name="*", group="What is known")
@dataclass(frozen=True)
class KnownOptions:
    """Prior knowledge of the sensors, of the source and of the ambient field.

    Parameters
    ----------
    sensors : str
        Ids of the sensors to use, separated by commas. Columns of other sensors are ignored. By default all.
    region : str
        Known bounds of the source [m], in the array's frame, such as "z>0" or "-1<x<1,z>0". Solutions outside them are
        discarded.
    max_moment_Am2 : float
        Largest possible moment of the source [A·m²]. Solutions with a larger moment are discarded.
    known_moment_Am2 : float
        Known modulus of the moment [A·m²]. It counts as one more measurement; a track uses it once, before its first
        row, and keeps it while the moment turns.
    known_moment_sigma_Am2 : float
        Standard deviation of --known-moment-Am2 [A·m²]; a tenth of the modulus by default.
    place : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin of the world frame, or of the array if the readings have
        no pose. The world frame is then east, north, up. Scalar sensors need it for the ambient field.
    date : str
        Date of the readings, such as 2026-11-21; needs --place.
    geomagnetic_model : str
        Model of the Earth's field: IGRF-14 (1900 to 2030) or WMM2025 (2025 to 2030). By default IGRF-14.
    """

    sensors: str | None = None
    region: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None
    max_moment_Am2: Annotated[float | None, Parameter(name="--max-moment-Am2")] = None
    known_moment_Am2: Annotated[float | None, Parameter(name="--known-moment-Am2")] = None
    known_moment_sigma_Am2: Annotated[float | None, Parameter(name="--known-moment-sigma-Am2")] = None
    place: Vector | None = None
    date: str | None = None
    geomagnetic_model: str | None = None

    @property
    def ids(self) -> list[str] | None:
        """Ids of the sensors to use; None for all."""
        return None if self.sensors is None else [name.strip() for name in self.sensors.split(",")]

    def array(self, path: Path) -> SensorArray:
        """Read the array of a file, with the sensors to use."""
        return self.select(arrays.read_array(path), path)

    def select(self, array: SensorArray, path: Path | str) -> SensorArray:
        """Return an array with the sensors to use, and --place and --date for a log without origin and date."""
        ids, columns = self.ids, array.columns
        if columns is not None and columns.is_geodetic and columns.origin is None and self.place is not None:
            columns = replace(columns, origin=self.place)
        if columns is not None and columns.date is None and columns.time_unit in ("iso", "hhmmss"):
            columns = replace(columns, date=None if self.date is None else self.date[:10])
        array = replace(array, columns=columns)
        if ids is None:
            return array
        for name in ids:
            if name not in array.ids:
                expected = f"ids of sensors in {path}: {', '.join(array.ids)}"
                raise InputError(f"--sensors: found {name!r}, expected {expected}.")
        try:
            return array.subset(ids)
        except ValueError as error:
            raise InputError(f"--sensors {','.join(ids)}: {error}") from None

    def map_origin(self, array: SensorArray) -> Vector | None:
        """Return the place on the Earth of the world frame's origin, from the array file or else --place."""
        own = None if array.columns is None else array.columns.origin
        if own is None or self.place is None:
            return own or self.place
        if any(abs(ours - theirs) > _SAME_deg for ours, theirs in zip(own[:2], self.place[:2], strict=True)):
            from arrays.io.world_maps import place_in_words

            _LOG.warning(f"--place is not the origin of the array file, which maps use: {place_in_words(own)}")
        return own

    def on_earth(self, array: SensorArray, log: Path) -> tuple[SensorArray, KnownOptions]:
        """Return the array with an origin of its places on the Earth, and options that know place and date.

        The origin comes from the array file or --place, or else is the first place of the log, which a note names. The
        date of the log or of the array file is used if nothing else gives the ambient field.
        """
        columns = array.columns
        if columns is None or not (columns.is_geodetic or self.place is not None):
            return array, self
        from magloc.logs.readings_table import date_of_log, origin_of_log

        if columns.is_geodetic and columns.origin is None:
            from arrays.io.world_maps import place_in_words

            origin, placed = origin_of_log(log, columns), log if columns.track is None else columns.track.path
            array = replace(array, columns=replace(columns, origin=origin))
            note(f"note: the origin of the world frame is the first place of {placed}: {place_in_words(origin)}")
        date = self.date
        is_known = array.ambient_T is not None or array.ambient_world_T is not None
        if date is None and array.channel_is_scalar.any() and not is_known:
            date = columns.date or date_of_log(log, columns)
        return array, replace(self, place=self.map_origin(array), date=date)

    @property
    def prior(self) -> SourcePrior:
        """Prior of the source."""
        low, high = [-math.inf] * 3, [math.inf] * 3
        for part in [] if self.region is None else self.region.split(","):
            bounds = _BOUNDS.fullmatch(part.replace(" ", ""))
            if not bounds:
                raise InputError(f"--region: found {part.strip()!r}, expected bounds such as z>0 or -1<x<1, in m.")
            i = "xyz".index(bounds["axis"])
            lower = bounds["below"] or (bounds["bound"] if bounds["sign"] == ">" else None)
            upper = bounds["bound"] if bounds["sign"] == "<" else None
            low[i] = max(low[i], float(lower)) if lower else low[i]
            high[i] = min(high[i], float(upper)) if upper else high[i]
            if not low[i] < high[i]:
                raise InputError(
                    f"--region: found {self.region!r}, expected bounds that leave some room along {bounds['axis']}."
                )
        refuse_outside(ABOVE_ZERO, math.inf, "a positive number", max_moment_Am2=self.max_moment_Am2)
        with naming_options("known_moment_Am2", "known_moment_sigma_Am2"):
            return magloc.SourcePrior(
                (low[0], low[1], low[2]),
                (high[0], high[1], high[2]),
                math.inf if self.max_moment_Am2 is None else self.max_moment_Am2,
                self.known_moment_Am2,
                self.known_moment_sigma_Am2,
            )

    @property
    def where(self) -> Place | None:
        """Place and date of the geomagnetic field; None without these options."""
        if self.place is None and self.date is None and self.geomagnetic_model is None:
            return None
        if self.place is None:
            given = "--date" if self.date is not None else "--geomagnetic-model"
            raise InputError(f"{given}: found no --place, expected --place LAT LON ALT_M with it.")
        if self.date is None:
            raise InputError("--place: found no --date, expected the date of the readings, such as --date 2026-11-21.")
        if not _DATE.fullmatch(self.date):
            raise InputError(f"--date: found {self.date!r}, expected a date such as 2026-11-21.")
        return Place(*self.place, self.date, self.geomagnetic_model or "IGRF-14")


@Parameter(name="*", group="Sensors")
@dataclass(frozen=True)
class LogOptions:
    """Sensors and columns of a log.

    Parameters
    ----------
    array : Path
        Array file (TOML). Beside --instrument it needs only the keys that differ from the template.
    instrument : str
        Instrument that wrote the log, such as magarrow or gsm19, instead of --array. An unknown name lists all.
    positions : Path
        Positions of the log in another file, instead of its own: a solution of RTKLIB or Emlid (.pos).
    """

    array: Path | None = None
    instrument: str | None = None
    positions: Path | None = None

    @property
    def name(self) -> str:
        """Name of the array, for messages."""
        return f"instrument {self.instrument}" if self.array is None else str(self.array)

    def sensors(self, log: Path) -> SensorArray:
        """Return the array, also of a single sensor, that the options state for a log."""
        array = self._sensors(log)
        if self.positions is None:
            return array
        own = arrays.LogColumns() if array.columns is None else array.columns
        nothing: dict[str, Any] = dict.fromkeys(("position", "geodetic", "crs", "height_m", "fix"))
        with naming("--positions"):
            columns = replace(own, **nothing, height_is="ellipsoid", track=arrays.read_track(self.positions))
        return replace(array, columns=columns)

    def _sensors(self, log: Path) -> SensorArray:
        if self.instrument is None:
            if self.array is None:
                raise InputError("--array: found neither --array nor --instrument, expected one of them.")
            return arrays.read_sensors(self.array)
        names = arrays.instrument_names()
        if self.instrument.lower() not in names:
            raise InputError(f"--instrument: found {self.instrument!r}, expected one of {', '.join(names)}.")
        template = arrays.read_instrument(self.instrument)
        array = template.array(log, self.array)
        if template.add:
            note(f"note: a log of {template.title} does not state: {template.add}")
        return array


class Mappable(Protocol):
    """A result that can be written as a map of the world."""

    def to_geojson(self, place: Vector) -> dict[str, Any]:
        """Return a FeatureCollection."""
        ...

    def to_kml(self, place: Vector) -> str:
        """Return placemarks."""
        ...


@Parameter(name="*", group="Maps of the world")
@dataclass(frozen=True)
class MapOptions:
    """Files for maps of the world.

    Parameters
    ----------
    geojson : Path
        GeoJSON file to write, with the positions of the sources; needs --place.
    kml : Path
        KML file to write, with the positions of the sources; needs --place.
    """

    geojson: Path | None = None
    kml: Path | None = None

    @property
    def outputs(self) -> dict[str, Path | None]:
        """Files to write, by their options."""
        return {"--geojson": self.geojson, "--kml": self.kml}

    def refuse(self, place: Vector | None) -> None:
        """Refuse, before long work, files without a place and files that cannot be written."""
        for option, path in self.outputs.items():
            if path is not None and place is None:
                raise InputError(f"{option}: found no --place, expected the origin of the world frame with it.")
            refuse_unwritable(path, option)

    def refuse_far(self, rows: Readings, name: str, *, always: bool = False) -> None:
        """Refuse, before long work, an array too far from the origin to be put on the Earth, if a map needs it."""
        from arrays.io.world_maps import check_near
        from magloc.measurement.plausibility import farthest_place

        if always or self != MapOptions():
            with naming(name):
                check_near(farthest_place(rows))

    def write(self, found: Mappable, place: Vector | None) -> None:
        """Write the files of the options."""
        if place is None:
            return
        if self.geojson is not None:
            with naming("--geojson"):
                text = framework.json_text(found.to_geojson(place))
            write_text(text + "\n", self.geojson)
        if self.kml is not None:
            with naming("--kml"):
                text = found.to_kml(place)
            write_text(text, self.kml)
