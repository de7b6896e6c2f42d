from magloc.readings import Readings as Readings
from magloc.readings import read_readings as read_readings
from magloc.truth import Truth as Truth
from magloc.truth import read_truth as read_truth
