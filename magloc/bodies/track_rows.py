"""Whitened rows of a track, of any missing channels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.measurement.rows import WhitenedRows
from magloc.measurement.whitened import WhitenedModel


@dataclass(frozen=True, eq=False)
class TrackRows:
    """Whitened rows of any missing channels, for the kernel."""

    model: WhitenedModel
    y: FloatArray
    n_differences: IntArray
    effects: FloatArray  # (n, a, C)


def joined_rows(groups: list[WhitenedRows], n: int, effects: list[FloatArray]) -> TrackRows:
    """Return rows of several groups in their order; common fields of fewer columns are filled up with zeros."""
    width = max(group.model.basis.shape[2] for group in groups)
    first = groups[0].model
    n_channels, n_errors = groups[0].y.shape[1], effects[0].shape[1]
    gain, y = np.zeros((n, n_channels, 3)), np.zeros((n, n_channels))
    basis, shrinkage = np.zeros((n, n_channels, width)), np.zeros((n, width))
    ambient, n_differences = np.zeros((n, *first.ambient.shape[1:])), np.zeros(n, dtype=np.intp)
    of_errors = np.zeros((n, n_errors, n_channels))
    for group, effect in zip(groups, effects, strict=True):
        at, q = group.index, group.model.basis.shape[2]
        gain[at], y[at], ambient[at] = group.model.gain, group.y, group.model.ambient
        basis[at, :, :q], shrinkage[at, :q] = group.model.basis, group.model.shrinkage
        n_differences[at], of_errors[at] = group.n_differences, effect
    model = replace(first, gain=gain, ambient=ambient, basis=basis, shrinkage=shrinkage)
    return TrackRows(model, y, n_differences, of_errors)
