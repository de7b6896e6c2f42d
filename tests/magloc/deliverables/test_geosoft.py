"""Geosoft XYZ, read back."""

from __future__ import annotations

import numpy as np

import magloc
from magloc.deliverables.geosoft import geosoft_xyz
from magloc.deliverables.map_frame import MapFrame


class TestGeosoftXyz:
    def test_holds_all_rows_line_by_line(self, survey: magloc.Survey, frame: MapFrame) -> None:
        lines = geosoft_xyz(survey, frame).splitlines()
        assert frame.crs in lines[0]
        assert lines[1].split()[:2] == (["/Longitude", "Latitude"] if frame.is_geographic else ["/X", "Y"])
        assert [line for line in lines if line.startswith("Line")] == [f"Line L{k}" for k in range(1, 7)]
        values = np.array([line.split() for line in lines if line[0] not in "/L"], dtype=np.float64)
        rows = survey.rows
        np.testing.assert_allclose(
            values[:, :2], frame.project(rows.place_m), rtol=0.0, atol=1e-8 if frame.is_geographic else 1e-3
        )
        np.testing.assert_allclose(
            values[:, 3:],
            np.stack([rows.time_s, 1e9 * rows.anomaly_T, 1e9 * rows.residual_T], axis=-1),
            rtol=0.0,
            atol=6e-4,
        )
