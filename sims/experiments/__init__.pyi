from sims.experiments.attitude import run_scenario as run_scenario
from sims.experiments.mockup_navigation import fused_runs as fused_runs
from sims.experiments.mockup_navigation import zeros_run as zeros_run
from sims.experiments.mockup_recording import fused_record as fused_record
from sims.experiments.mockup_vision import identified_files as identified_files
from sims.experiments.mockup_vision import sky_run as sky_run
from sims.experiments.paper_tables import PAPER_ROWS as PAPER_ROWS
from sims.experiments.paper_tables import compared_with_paper as compared_with_paper
