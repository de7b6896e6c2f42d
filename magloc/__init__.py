"""Magnetic models, and the estimation of magnetic dipoles from the differences between sensors."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Bounds": "magloc.bounds.crlb",
        "Calibration": "magloc.calibration.results",
        "CalibrationPrior": "magloc.calibration.array",
        "Design": "magloc.design.optimise",
        "DesignTask": "magloc.design.task",
        "MatchedFilterDetector": "magloc.detection.matched_filter",
        "Source": "magloc.localization.fit.results",
        "bound_map": "magloc.bounds.maps",
        "calibrate": "magloc.calibration.calibrate",
        "convergence_map": "magloc.convergence.over_starts",
        "cramer_rao_bounds": "magloc.bounds.crlb",
        "design_array": "magloc.design.optimise",
        "detection_range": "magloc.detection.detection_range",
        "dipole": ":magloc.fields.dipole",
        "equivalent_dipole": "magloc.fields.body",
        "geomagnetic": ":magloc.fields.geomagnetic",
        "moments_on_sphere": "magloc.directions",
        "plots": ":magloc.plots",
        "source_map": "magloc.convergence.over_sources",
        "view": "magloc.viewer.view",
        "Readings": "magloc.readings",
        "Truth": "magloc.truth",
        "read_readings": "magloc.readings",
        "read_truth": "magloc.truth",
    },
)
