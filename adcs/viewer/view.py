"""An attitude in three dimensions: in a browser, in a notebook, as a page, a picture or a film."""

from __future__ import annotations

from pathlib import Path

from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from adcs.io.imu_files import ImuLog
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry
from adcs.viewer.attitude_page import attitude_page
from adcs.viewer.attitude_replay import replay_of
from arrays.typing import FloatArray
from magloc.viewer.outputs import check_outputs
from magloc.viewer.server import FIRST_PORT
from magloc.viewer.view import View, shown


def view(
    track: AttitudeTrack,
    readings: Telemetry | InertialMagneticRecord | ImuLog | None = None,
    satellite: Satellite | None = None,
    *,
    truth: FloatArray | None = None,
    html: str | Path | None = None,
    png: str | Path | None = None,
    movie: str | Path | None = None,
    open: bool = True,
    port: int = FIRST_PORT,
    title: str = "",
) -> View:
    """See an attitude through time in three dimensions.

    Body axes with their 3σ cones, the true ones, the field and the Sun as measured and as expected, and which sensors
    have readings. Errors and cones are enlarged where they would not be seen. As :func:`magloc.view` it opens a
    browser, shows itself in a notebook, or writes files.

    Parameters
    ----------
    track : AttitudeTrack
        Of any filter.
    readings : Telemetry, InertialMagneticRecord or ImuLog, optional
        That the track was made of: what was measured is shown beside what was to be expected.
    satellite : Satellite, optional
        Of the telemetry: whose orbit says where field and Sun are.
    truth : ndarray, shape (n, 4), optional
        True attitude, scalar first, NaN where unknown, at the rows of the readings: orbital frame from body of
        telemetry, otherwise the frame of the track. By default that of an ImuLog.
    html, png, movie : path, optional
        Write a static page that plays or, by Chromium, a picture or a film (.mp4, .gif, .apng); serve nothing.
    open : bool
        Open the browser.
    port : int
        The next one that is free is taken if it is in use.
    title : str
        By default the track's.

    Raises
    ------
    ValueError
        Telemetry comes without its satellite, or the truth has another number of rows.
    InputError
        A file cannot be written, or Chromium is not there.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> track = adcs.estimate(log.telemetry, log.satellite, sensors="mag+sun+gyro")
    >>> view = adcs.view(track, log.telemetry, log.satellite, html="attitude.html")
    """
    check_outputs(html, png, movie)
    if isinstance(readings, ImuLog):
        truth = readings.q_true if truth is None else truth
        readings = readings.record
    replay = replay_of(track, readings, satellite, truth, title)
    return shown(
        f"adcs · {replay.title}",
        lambda server: attitude_page(server, replay),
        html=html,
        png=png,
        movie=movie,
        open=open,
        port=port,
    )
