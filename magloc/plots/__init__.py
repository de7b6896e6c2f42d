"""Figures of results for print, in one house style (:mod:`magloc.plots.style`)."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "bound_reach": "magloc.plots.bounds",
        "bound_slices": "magloc.plots.bounds",
        "bound_sphere": "magloc.plots.bounds",
        "cramer_rao_bounds": "magloc.plots.bounds:bounds_figure",
        "calibration": "magloc.plots.calibrations",
        "compensation": "magloc.plots.compensations",
        "consistency": "magloc.plots.tracks:consistency_figure",
        "convergence": "magloc.plots.maps",
        "design": "magloc.plots.designs",
        "design_counts": "magloc.plots.designs",
        "fixes": "magloc.plots.localization",
        "residuals": "magloc.plots.localization",
        "save": "magloc.plots.style",
        "signature": "magloc.plots.signatures:signature_figure",
        "source_tracks": "magloc.plots.tracks:sources_figure",
        "sources": "magloc.plots.maps",
        "survey": "magloc.plots.surveys:survey_figure",
        "survey_profiles": "magloc.plots.profiles",
        "track": "magloc.plots.tracks:track_figure",
        "write": "magloc.plots.style",
    },
)
