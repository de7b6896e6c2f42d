"""Base classes of results, and their quantities with units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from html import escape
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from arrays.io.csv import Column
from arrays.io.lazy import by_name
from arrays.io.units import unit_of_column

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

MOST_SHOWN = 10
"""Number of rows that the representation of a long result shows."""


class Quantity(NamedTuple):
    """Quantity of a result.

    Attributes
    ----------
    unit : str
        Unit, as in the CF conventions.
    description : str
    dimensions : tuple of str
        Dimensions after that of the rows.
    """

    unit: str
    description: str
    dimensions: tuple[str, ...] = ()


class Drawn:
    """Result with a figure.

    Attributes
    ----------
    figure : str
        Function that draws the result, as ``module:function``, on a higher floor.
    """

    figure: ClassVar[str]

    def plot(self) -> Figure:
        """Draw the result."""
        return by_name(self.figure)(self)


class Result(Drawn, ABC):
    """Result as text, as a figure, and as tables for other programs.

    Attributes
    ----------
    quantities : mapping of str to Quantity
        Attributes that are variables of the dataset.
    dimension : str
        Dimension of the rows.
    command : str
        Command that gives the same result.
    """

    quantities: ClassVar[Mapping[str, Quantity]] = MappingProxyType({})
    dimension: ClassVar[str] = "row"
    command: ClassVar[str]

    @property
    @abstractmethod
    def frame(self) -> str:
        """Frame of positions and moments."""

    @abstractmethod
    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, of at most `most` rows."""

    @abstractmethod
    def columns(self) -> dict[str, Column]:
        """Return the columns of the CSV file, whose names end in their units."""

    @property
    def about(self) -> dict[str, str]:
        """Frame, version and command of the result."""
        from arrays.io.outputs import installed_version

        return {"frame": self.frame, "source": f"magloc {installed_version()}, {self.command}"}

    def table(self) -> str:
        """Return the table that the command prints."""
        return "\n".join(self.lines())

    def to_dataframe(self) -> pd.DataFrame:
        """Return the columns of the CSV file as a data frame, whose ``attrs`` have the units by their names."""
        import pandas as pd

        columns = self.columns()
        frame = pd.DataFrame(columns)
        frame.attrs = {**self.about, "units": {name: unit_of_column(name) for name in columns}}
        return frame

    def to_xarray(self) -> xr.Dataset:
        """Return the quantities as a dataset with units and names, or without any the columns of the CSV file."""
        if not self.quantities:
            return self.dataset({name: ((self.dimension,), values) for name, values in self.columns().items()})
        dimensions = {name: (self.dimension, *of.dimensions) for name, of in self.quantities.items()}
        return self.dataset({name: (of, getattr(self, name)) for name, of in dimensions.items()})

    def dataset(self, variables: Mapping[str, tuple[tuple[str, ...], Any]]) -> xr.Dataset:
        """Return a dataset of variables, given by their dimensions and values."""
        import xarray as xr

        described = {}
        for name, (dimensions, values) in variables.items():
            of = self.quantities.get(name) or Quantity(unit_of_column(name), name)
            described[name] = (dimensions, np.asarray(values), {"units": of.unit, "long_name": of.description})
        dataset = xr.Dataset(described, attrs=self.about).set_coords("time_s" if "time_s" in described else [])
        return dataset.assign_coords(axis=list("xyz")) if "axis" in dataset.dims else dataset

    def __repr__(self) -> str:
        return "\n".join(self.lines(MOST_SHOWN))

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"
