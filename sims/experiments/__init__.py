"""Simulated experiments, and those that repeat the papers."""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "PAPER_ROWS": "sims.experiments.paper_tables",
        "compared_with_paper": "sims.experiments.paper_tables",
        "detumbling": "sims.experiments.b_dot",
        "identified_files": "sims.experiments.mockup_vision",
        "fused_record": "sims.experiments.mockup_recording",
        "fused_runs": "sims.experiments.mockup_navigation",
        "run_scenario": "sims.experiments.attitude",
        "sky_run": "sims.experiments.mockup_vision",
        "switching_loads": "sims.experiments.loads",
        "zeros_run": "sims.experiments.mockup_navigation",
    },
)
