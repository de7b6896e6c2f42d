from sims import experiments as experiments
from sims.attitude.scenario import AttitudeScenario as AttitudeScenario
from sims.magnetics.files import write_simulation as write_simulation
from sims.magnetics.scenario import MagneticScenario as MagneticScenario
from sims.montecarlo import run_many as run_many
from sims.scenarios import read_scenario as read_scenario
from sims.scenarios import simulate as simulate
