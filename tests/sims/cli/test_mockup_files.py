"""Columns of the mock-up's files: each is the state that it is named after, in the unit of its name."""

from __future__ import annotations

import numpy as np

from adcs.mockup.navigation.delayed_ekf import STATES, FilterTrack
from sims.cli.mockup_files import _track_columns


def test_columns_are_their_namesakes() -> None:
    values = np.arange(1.0, 11.0) * np.array([[1.0], [2.0]])  # by row and state
    state = {name: values[:, i] for i, name in enumerate(STATES)}
    pairs = [np.stack([state[name] for name in names], axis=-1) for names in (STATES[0:2], STATES[2:4], STATES[5:7])]
    position, velocity, zero = pairs
    track = FilterTrack(
        np.array([0.0, 1.0]),
        position,
        velocity,
        state["heading_rad"],
        zero,
        state["zero_rate_rad_s"],
        values[:, 8:],
        values,
    )
    columns = _track_columns("true_", track)
    for name, wanted in {
        "true_x_m": state["X_m"],
        "true_y_m": state["Y_m"],
        "true_vx_m_s": state["vX_m_s"],
        "true_vy_m_s": state["vY_m_s"],
        "true_heading_deg": np.degrees(state["heading_rad"]),
        "zero_x_m_s2": state["zero_x_m_s2"],
        "zero_y_m_s2": state["zero_y_m_s2"],
        "zero_rate_deg_s": np.degrees(state["zero_rate_rad_s"]),
        "sigma_x_mm": 1e3 * state["X_m"],
        "sigma_y_mm": 1e3 * state["Y_m"],
        "sigma_heading_deg": np.degrees(state["heading_rad"]),
    }.items():
        np.testing.assert_allclose(columns.pop(name), wanted, err_msg=name)
    assert columns == {}
