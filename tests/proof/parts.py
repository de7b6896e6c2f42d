"""All parts of the page, in its order."""

from tests.proof.inertial import BROAD, OPTITRACK
from tests.proof.magnets import ARRAY, MOCAP
from tests.proof.plates import COIL, PLATE
from tests.proof.stars import FRAMES, PHOTOGRAPHS, SPACE
from tests.proof.station import STATION

PARTS = (MOCAP, ARRAY, PLATE, COIL, STATION, FRAMES, SPACE, PHOTOGRAPHS, BROAD, OPTITRACK)
