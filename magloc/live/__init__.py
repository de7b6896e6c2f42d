"""Tracking of sources while their readings come in from a pipe, a socket, a serial port or a replayed file."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Follower": "magloc.live.follower",
        "LivePoint": "magloc.live.follower",
        "Tally": "magloc.live.tally",
        "track": "magloc.live.follower",
    },
)
