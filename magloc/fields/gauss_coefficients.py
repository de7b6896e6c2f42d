"""Gauss coefficients of the geomagnetic models: IGRF-14 from the package ppigrf, WMM2025 from wmm-calculator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import of_extra
from arrays.typing import FloatArray

FIELD = "the Earth's magnetic field"


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Gauss coefficients of one model, K of each kind at T nodes in time.

    Attributes
    ----------
    name : str
        Name of the model.
    year : ndarray, shape (T,)
        Decimal years of the nodes, ascending; the model is valid from the first to the last.
    degree, order : ndarray, shape (K,)
        n and m of each coefficient.
    g_T, h_T : ndarray, shape (T, K)
        Coefficients of cos mφ and sin mφ [T].
    """

    name: str
    year: FloatArray
    degree: NDArray[np.int64]
    order: NDArray[np.int64]
    g_T: FloatArray
    h_T: FloatArray

    def at(self, year: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return coefficients g and h, both (..., K) [T], at decimal years (...).

        Raises
        ------
        ValueError
            If a year is outside the model's validity.
        """
        first, last = self.year[0], self.year[-1]
        outside = ~((year >= first) & (year <= last))
        if np.any(outside):
            raise ValueError(
                f"Input date must lie within the validity of {self.name}, {first:.1f} to {last:.1f}; "
                f"instead received {year[outside].flat[0]}."
            )
        node = np.clip(np.searchsorted(self.year, year, side="right") - 1, 0, len(self.year) - 2)
        w = ((year - self.year[node]) / (self.year[node + 1] - self.year[node]))[..., None]
        return (1 - w) * self.g_T[node] + w * self.g_T[node + 1], (1 - w) * self.h_T[node] + w * self.h_T[node + 1]


Model = str | Coefficients
"""Name of a model, or coefficients, for example of a model that ends at a lower degree."""


def coefficients(model: Model) -> Coefficients:
    """Return the Gauss coefficients of a model.

    Parameters
    ----------
    model : str or Coefficients
        "IGRF-14" (1900 to 2030) or "WMM2025" (2025 to 2030); coefficients are returned as they are.

    Raises
    ------
    ValueError
        If there is no model of that name.
    """
    if isinstance(model, Coefficients):
        return model
    if model not in _READERS:
        raise ValueError(f"Input model must be one of {', '.join(_READERS)}; instead received {model!r}.")
    return _READERS[model]()


@cache
def _igrf14() -> Coefficients:
    # Imported here because ppigrf imports pandas, which takes longer than all the rest of this package.
    with of_extra("geo", FIELD):
        from ppigrf import ppigrf

    g, h = ppigrf.read_shc(ppigrf.shc_fn_igrf14)
    degree, order = np.array(list(g.columns), dtype=np.int64).T
    years = np.asarray(g.index.year, dtype=np.float64)  # every node is a 1 January
    return Coefficients("IGRF-14", years, degree, order, 1e-9 * g.to_numpy(float), 1e-9 * h.to_numpy(float))


@cache
def _wmm2025() -> Coefficients:
    with of_extra("geo", FIELD):
        from wmm import wmm_calc

    table = wmm_calc().load_coeffs()
    if table["model_name"] != "WMM-2025":
        raise RuntimeError(f"The installed wmm-calculator holds {table['model_name']}; WMM2025 needs version 1.4.")
    degree, order = np.array([(n, m) for n in range(1, 13) for m in range(n + 1)]).T
    rows = degree * (degree + 1) // 2 + order
    g, h, g_rate, h_rate = (1e-9 * np.asarray(table[key], dtype=np.float64)[rows] for key in ("g", "h", "g_sv", "h_sv"))
    # The secular variation is constant, so the model is the straight line through its epoch and its end.
    years = np.array([2025.0, 2030.0])
    return Coefficients("WMM2025", years, degree, order, np.stack([g, g + 5 * g_rate]), np.stack([h, h + 5 * h_rate]))


_READERS = {"IGRF-14": _igrf14, "WMM2025": _wmm2025}
MODELS = tuple(_READERS)
"""Names of the models."""
