"""Magnetic models, and the estimation of magnetic dipoles from the differences between sensors."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Readings": "magloc.readings",
        "Truth": "magloc.truth",
        "read_readings": "magloc.readings",
        "read_truth": "magloc.truth",
    },
)
