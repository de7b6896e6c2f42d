"""Ambient field of each row of readings: from the readings, the array file or the geomagnetic model."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from arrays.io.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from arrays.array import SensorArray
    from magloc.readings import Readings

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Place:
    """Place and date for the geomagnetic field.

    Attributes
    ----------
    latitude_deg, longitude_deg, height_m : float
        Geodetic coordinates; the height is above the WGS-84 ellipsoid.
    date : str
        Date in ISO 8601, such as 2026-11-21.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    date: str
    model: str


def in_world_field(readings: Readings, array: SensorArray) -> Readings:
    """Return readings with the array's world ambient field in each row, unless they have one already."""
    if array.ambient_world_T is None or readings.ambient_T is not None:
        return readings
    if readings.array_rotation is None:
        if array.ambient_T is not None:
            return readings
        raise InputError(
            "key ambient_world_nT of the array file: found no pose in the readings, expected columns array_x_m and so"
            " on."
        )
    return replace(readings, ambient_T=readings.array_rotation.inv().apply(array.ambient_world_T))


def with_ambient_field(
    array: SensorArray, readings: Readings, place: Place | None, *, gradient: bool
) -> tuple[SensorArray, NDArray[np.float64] | None]:
    """Return the array with its ambient field, and the field of every row if it differs between rows.

    The readings' own columns take precedence, then the array file, then the geomagnetic model. The model's axes are
    east, north and up: the axes of the world frame, or of the array if the readings have no pose.
    """
    readings = in_world_field(readings, array)
    model_T = gradient_T_m = None
    if place is not None:
        model_T, gradient_T_m = _of_model(place)
    if gradient:
        if gradient_T_m is None:
            raise InputError("Input ambient_gradient: found no place, expected a place and a date with it.")
        if readings.array_rotation is not None:
            raise InputError("Input ambient_gradient: found an array with a pose, expected one without.")
        rows = [(float(x), float(y), float(z)) for x, y, z in gradient_T_m]
        array = replace(array, ambient_gradient_T_m=tuple(rows))
    scalar = bool(array.channel_is_scalar.any())
    if scalar and readings.ambient_T is None and array.ambient_T is not None and _turns(readings):
        raise InputError(
            "key ambient_nT of the array file: found readings of an array that rotates, expected one at rest. State"
            " ambient_world_nT, columns ambient_x_nT and so on in the readings, or place and date."
        )
    if scalar and array.common_field_T is not None:
        _LOG.warning(
            "common_field_nT is one offset of all moduli: differences between scalar sensors in a change of the ambient"
            " field are not modelled"
        )
    if readings.ambient_T is not None or array.ambient_T is not None:
        if place is not None and not gradient:
            where = "readings have" if readings.ambient_T is not None else "array file has"
            _LOG.info(f"place and date are not used: the {where} the ambient field")
        return array, readings.ambient_T
    if model_T is None:
        if scalar:
            _LOG.warning(
                "no ambient field is known (ambient_x_nT and so on in the readings, ambient_nT or ambient_world_nT in"
                " the array file, or place and date): moduli count as those of the source alone"
            )
        return array, None
    if scalar and not array.row_ambient_uncertainty_T:
        _LOG.info("note: the geomagnetic model counts as exact; crust and storms add errors of about 100 nT")
    if readings.array_rotation is None:
        return array.in_ambient_field(model_T), None
    return array, readings.array_rotation.inv().apply(model_T)


def _turns(readings: Readings) -> bool:
    """Return True if the array turns by more than a milliradian between the rows."""
    if readings.array_rotation is None:
        return False
    rotations = readings.array_rotation.as_quat()
    return bool((abs(rotations @ rotations[0]) < 1.0 - 1e-7).any())


def modulus_at(place: Place) -> float:
    """Return the modulus of the geomagnetic field at a place and date [T]."""
    import numpy as np

    return float(np.linalg.norm(field_at(place)))


def field_at(place: Place) -> NDArray[np.float64]:
    """Return the geomagnetic field (3,) at a place and date [T]: east, north, up."""
    return _of_model(place)[0]


def _of_model(place: Place) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    import numpy as np

    from magloc.fields.geomagnetic import MODELS, field_enu, gradient_enu

    if place.model not in MODELS:
        raise InputError(f"Input geomagnetic_model: found {place.model!r}, expected one of {', '.join(MODELS)}.")
    try:
        date = np.datetime64(place.date)
    except ValueError:
        raise InputError(f"Input date: found {place.date!r}, expected a date such as 2026-11-21.") from None
    where = (place.latitude_deg, place.longitude_deg, place.height_m, date, place.model)
    try:
        return field_enu(*where), gradient_enu(*where)
    except ValueError as error:
        wrong = "date" if "date" in str(error) else "place"
        raise InputError(f"Input {wrong}: {str(error).removeprefix('Input ')}") from None
