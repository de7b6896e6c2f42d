"""A signature as a table for people, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.tables import align, by_sigma
from arrays.typing import FloatArray
from magloc.localization.fit.results import values_of

if TYPE_CHECKING:
    from magloc.signature.signature import Signature

HEADINGS = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0}
# Distance along the keel to either side, in depths.
_REACH = 3.0
_POINTS = 61


def lines_of_signature(signature: Signature) -> list[str]:
    """Return the parameters with σ, undetermined combinations, and the goodness of fit."""
    determined = signature.determined
    cells = [["part", "A·m²", "σ", ""]]
    for name, value, sigma in zip(signature.names, determined, signature.sigma_Am2, strict=True):
        cells.append([name, *(by_sigma(value, sigma) if np.isfinite(value) else "--"), ""])
    lines = align(cells, left=1)
    if signature.components.induced != "none":
        lines.append(f"induced at {1e9 * signature.components.ambient_T:.0f} nT")
    if signature.components.eddy:
        lines.append(f"eddy at {1e9 * signature.components.rate_T_s:.3g} nT/s")
    lines += [f"not determined by these headings: {what}" for what in signature.undetermined]
    lines.append(
        f"χ² {signature.chi2:.0f} of {signature.dof} in {signature.rows} rows" + (", misfit" * signature.misfit)
    )
    return lines


def along_keel(signature: Signature, depth_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places along the keel (k,) [m], the field there and its covariance.

    The field (4, k, 3) is at a depth below the object, on four headings.
    """
    x = depth_m * np.linspace(-_REACH, _REACH, _POINTS)
    offset = np.stack([x, np.zeros_like(x), np.full_like(x, -depth_m)], axis=-1)
    headings = np.tile(np.array(list(HEADINGS.values()))[:, None], (1, _POINTS))
    return x, *signature.field(np.broadcast_to(offset, (len(HEADINGS), *offset.shape)), headings)


def lines_of_depths(signature: Signature, depths_m: Sequence[float]) -> list[str]:
    """Return a table of the largest field below the object at some depths, on four headings."""
    rows = [["depth_m", "heading", "largest_nT", "σ_nT", "forward_m", ""]]
    for depth in depths_m:
        x, field, covariance = along_keel(signature, depth)
        for heading, of_field, of_covariance in zip(HEADINGS, field, covariance, strict=True):
            modulus = np.linalg.norm(of_field, axis=1)
            k = int(np.argmax(modulus))
            direction = of_field[k] / modulus[k]
            sigma = float(_sigma(direction @ of_covariance[k] @ direction))
            of_field_nT = by_sigma(1e9 * float(modulus[k]), 1e9 * sigma)
            rows.append([f"{depth:g}", heading, *of_field_nT, f"{x[k]:.1f}", ""])
    return align(rows) if depths_m else []


def json_of_signature(signature: Signature, depths_m: Sequence[float]) -> dict[str, object]:
    """Return the JSON that ``magloc signature --json`` prints."""
    predicted = []
    for depth in depths_m:
        x, field, covariance = along_keel(signature, depth)
        sigma = _sigma(np.diagonal(covariance, axis1=-2, axis2=-1))
        for i, heading in enumerate(HEADINGS.values()):
            of_heading = {"depth_m": depth, "heading_deg": heading, "forward_m": x}
            predicted.append(of_heading | {"field_nT": 1e9 * field[i], "sigma_nT": 1e9 * sigma[i]})
    return values_of(signature, ("permanent_Am2", "polarisability_m3")) | {
        "eddy_m3_s": signature.eddy_m3_s if signature.components.eddy else None,
        "parameters": list(signature.names),
        "parameters_Am2": signature.determined,
        "sigma_Am2": np.where(np.isfinite(signature.determined), signature.sigma_Am2, np.nan),
        "covariance": signature.covariance,
        "ambient_nT": 1e9 * signature.ambient_T,
        **values_of(signature, ("undetermined", "chi2", "dof", "misfit", "rows")),
        "predicted": predicted,
    }


def _sigma(variance: FloatArray) -> FloatArray:
    """Return standard deviations; NaN if rounding has made a variance negative."""
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))
