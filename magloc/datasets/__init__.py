"""Small simulated recordings that come with the package, for a first try, for pages and for tests.

They are what ``magloc simulate`` gives, at fewer rows a second: :mod:`sims` makes them, and a test makes them again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from arrays.array import SensorArray
from arrays.array_file import read_array
from arrays.io.toml import BuiltIn
from magloc.readings import Readings, read_readings
from magloc.truth import Truth, read_truth

_FILES = BuiltIn("magloc", "datasets", "recording", "-truth.csv")


@dataclass(frozen=True, eq=False)
class Dataset:
    """A recording with the truth behind it.

    Attributes
    ----------
    array : SensorArray
        As its user knows it.
    readings : Readings
    truth : Truth
        Truth of the source in the frame of the results, which is the world's if the array moves.
    path : Path
        Of the readings file; NAME-array.toml and NAME-truth.csv stand beside it.
    """

    array: SensorArray
    readings: Readings
    truth: Truth
    path: Path

    def __repr__(self) -> str:
        return f"<Dataset {self.path.stem!r}: {len(self.readings)} rows of {self.array}, with the truth>"


def names() -> tuple[str, ...]:
    """Names of the recordings.

    ``board``: a magnet in a hand over 30 magnetoresistive sensors; ``diver``: a fluxgate tetrahedron is carried past a
    buried object; ``drone``: four optically pumped sensors survey a field; ``ship``: a boat passes over eight fluxgates
    on the bottom of a harbour.
    """
    return _FILES.names()


def load(name: str) -> Dataset:
    """A recording by its name.

    Raises
    ------
    InputError
        There is none of that name.
    """
    truth = _FILES.chosen(name)
    path = truth.with_name(f"{name}.csv")
    array = read_array(path.with_name(f"{name}-array.toml"))
    return Dataset(array, read_readings(path, array), read_truth(truth), path)
