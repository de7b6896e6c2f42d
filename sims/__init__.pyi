from sims.magnetics.files import write_simulation as write_simulation
from sims.magnetics.scenario import Scenario as Scenario
from sims.magnetics.scenario_files import built_in_scenarios as built_in_scenarios
from sims.magnetics.scenario_files import read_scenario as read_scenario
from sims.magnetics.simulation import Simulation as Simulation
from sims.magnetics.simulation import simulate as simulate
