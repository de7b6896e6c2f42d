"""Steps of the complementary filters: many runs at once, and one long record."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from adcs.complementary.adaptive import adaptive_track
from adcs.complementary.explicit import complementary_track
from sims.attitude.complementary import SatelliteScenario, satellite_runs
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved

TITLE = "complementary filters: one step, 1 thread"
TRACKS = {
    "explicit": complementary_track,
    "with measured quaternion": partial(complementary_track, method="gauss-newton"),
    "adaptive error-state": adaptive_track,
}


def rows(size: Size) -> Iterator[Row]:
    """Of a satellite's record there is no peer: ``inertial`` has those of a unit on Earth."""
    batch = satellite_runs(SatelliteScenario(duration_s=4999.0), range(20)).record
    long = satellite_runs(SatelliteScenario(duration_s=size.points - 1.0), [0]).record
    contestants = {}
    for name, track in TRACKS.items():
        contestants[f"{name}, 20 runs"] = Contestant(lambda track=track: track(batch), 1, 20 * len(batch))
        contestants[f"{name}, one long record"] = Contestant(lambda track=track: track(long), 1, len(long))
    for name, timing in interleaved(contestants, size.rounds).items():
        yield Row(name, timing, note=f"{1e-6 / timing.best:.1f} M steps/s")
