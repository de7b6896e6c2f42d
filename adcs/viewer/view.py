"""View of an attitude in three dimensions, in a browser, in a notebook, as a page, picture or film."""

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
from magloc.viewer.view import View, open_view


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
    """View an attitude over time in three dimensions.

    The scene shows estimated body axes with 3σ cones, true body axes, and the field and the Sun as measured and as
    expected; panels show which sensors have readings. Errors and cones are enlarged if they would be invisible. Like
    :func:`magloc.view`, the view opens a browser, shows itself in a notebook, or writes files.

    Parameters
    ----------
    track : AttitudeTrack
        Result of any filter.
    readings : Telemetry, InertialMagneticRecord or ImuLog, optional
        Readings of the track, whose directions are shown beside the expected ones.
    satellite : Satellite, optional
        Satellite of the telemetry, whose orbit gives the directions of field and Sun.
    truth : ndarray, shape (n, 4), optional
        True attitude at the rows of the readings, scalar first, NaN where unknown: from the body to the orbital frame
        for telemetry, otherwise to the frame of the track. By default that of an ImuLog.
    html, png, movie : path, optional
        Write a static page with a player or, by Chromium, a picture or a film (.mp4, .gif, .apng), and serve nothing.
    open : bool
        Open the browser.
    port : int
        Port of the server; if it is in use, the next free one is used.
    title : str
        Title of the page; by default that of the track.

    Returns
    -------
    View
        The open page, or the one that was written.

    Raises
    ------
    ValueError
        Telemetry comes without its satellite, or the truth has another number of rows.
    InputError
        A file cannot be written, or there is no Chromium.

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
    return open_view(
        f"adcs · {replay.title}",
        lambda server: attitude_page(server, replay),
        html=html,
        png=png,
        movie=movie,
        open=open,
        port=port,
    )
