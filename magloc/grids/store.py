"""Maps of any size, streamed to a zarr store that can resume an interrupted map.

The store (zarr version 3, ``xarray.open_zarr`` opens it) has one chunk per box of the cube. The duration of a chunk in
``seconds_of_chunk`` is written last and marks the chunk as done. After an interruption only chunks without this mark
are computed again. Only one box is in memory at a time.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.closing import Closing, delay_signals
from arrays.io.errors import InputError, of_extra
from arrays.typing import FloatArray
from magloc.grids.cube import (
    DIMENSIONS,
    Box,
    Chunk,
    CubeMap,
    Values,
    coordinates,
    tiles,
)

if TYPE_CHECKING:
    import xarray as xr
    import zarr


SECONDS_OF_CHUNK = "seconds_of_chunk"
_SOMETHING_ELSE = "{}: found something else than a map, expected a map or nothing."
# Errors of zarr and xarray for a truncated or damaged store; they depend on the damaged part and the codec.
UNREADABLE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    UserWarning,
    ValueError,
)


class Sweep(Closing):
    """Store of one map, open for writing; as a context manager it locks out other writing processes.

    Parameters
    ----------
    path : path-like
        Folder of the store; created if it does not exist.

    Attributes
    ----------
    unreadable : list of str
        One sentence for every chunk that is done but cannot be read, and is computed again.

    Raises
    ------
    InputError
        The path holds something else or another map, or another process is writing to it. Nothing is changed.
    OSError
        The store cannot be created.
    """

    def __init__(self, cube: CubeMap, path: str | os.PathLike[str]) -> None:
        self.cube = cube
        self.path = Path(path)
        self.points_done = 0
        self.unreadable: list[str] = []
        if not self.path.exists():
            _make_store(cube, self.path)
        elif not self.path.is_dir():
            raise InputError(f"{self.path}: found a file, expected a map or nothing.")
        self._lock = _locked(self.path)
        try:
            self._group = _opened(self.path)
            self._arrays = _arrays_of_same_map(cube, self._group, self.path)
            self._marks = self._arrays.pop(SECONDS_OF_CHUNK)
            self._seconds = _readable_marks(self._marks)
            self._edge = _edge(self._arrays, self._seconds, self.path)
            self._count_done()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the lock, so that other processes can write."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the whole map."""
        return int(self._seconds.size)

    @property
    def chunks_done(self) -> int:
        """Number of chunks that are done."""
        return int(np.isfinite(self._seconds).sum())

    def unfinished(self) -> Iterator[Box]:
        """Yield the boxes that are not done."""
        return (box for box in self._boxes() if np.isnan(self._seconds[box.place]))

    def write(self, chunks: Iterable[Chunk], progress: Callable[[int], None] | None = None) -> None:
        """Write chunks as they arrive; if one cannot be written, those before it are done."""
        for chunk in chunks:
            with delay_signals():
                for name, array in self._arrays.items():
                    array[chunk.box.region] = chunk.values[name]
                self._marks[chunk.box.place] = chunk.seconds
                self._count(chunk.box, chunk.seconds)
            if progress is not None:
                progress(chunk.box.size)

    def _boxes(self) -> Iterator[Box]:
        return tiles(self.cube.grid, self._edge)

    def _count(self, box: Box, seconds: float) -> None:
        self._seconds[box.place] = seconds
        self.points_done += box.size

    def _count_done(self) -> None:
        for box in self._boxes():
            if np.isnan(self._seconds[box.place]):
                continue
            try:
                for name, array in self._arrays.items():
                    _check_stated_size(array, self.path.joinpath(name, "c", *map(str, box.place)))
                values = {name: np.asarray(array[box.region]) for name, array in self._arrays.items()}
                self._check_complete(values)
            except UNREADABLE as error:
                self.unreadable.append(f"{self.path}: chunk {box.place} cannot be read ({error}) and is computed again")
                self._marks[box.place] = self._seconds[box.place] = np.nan
            else:
                self._count(box, self._seconds[box.place])

    def _check_complete(self, values: Values) -> None:
        for name, variable in self.cube.variables.items():
            if not np.isnan(variable.not_done) and (values[name] == variable.not_done).any():
                raise ValueError(f"{name} is missing")


def open_map(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open the map in a store, loaded piece by piece; NaN or the smallest integer if a chunk is not done."""
    import xarray as xr

    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*not recognized as a component")  # the metadata of an array are damaged
        group = _opened(Path(path))
        # Open arrays one by one: zarr retrieves only one error of several, and asyncio prints the others.
        for name in (folder.name for folder in sorted(Path(path).iterdir()) if folder.is_dir()):
            array = group[name]
            for file in Path(path, name, "c").rglob("*"):
                _check_stated_size(array, file)
        dataset = xr.open_zarr(path, chunks=None, consolidated=False)
    seconds = float(dataset[SECONDS_OF_CHUNK].sum())
    dataset = dataset.drop_vars(SECONDS_OF_CHUNK).assign_attrs(seconds=seconds)
    for variable in dataset.data_vars.values():
        if "flag_values" in variable.attrs:  # JSON loses the type; netCDF and CF need that of the variable
            variable.attrs["flag_values"] = np.asarray(variable.attrs["flag_values"], dtype=variable.dtype)
    return dataset


def chunk_seconds(path: str | os.PathLike[str]) -> FloatArray:
    """Return the duration of every chunk of a store, NaN if it is not done; empty without a map."""
    try:
        return _readable_marks(_opened(Path(path))[SECONDS_OF_CHUNK])
    except UNREADABLE:
        return np.empty(0)


def _as_json(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes as they are after a round trip through a store."""
    return json.loads(json.dumps(dict(attributes), default=lambda value: value.tolist()))


def _make_store(cube: CubeMap, path: Path) -> None:
    """Create an empty store in one step, so that an interruption leaves no incomplete store."""
    with of_extra("maps", "a stored map"):
        import zarr
        from zarr.codecs import ZstdCodec

    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        group = zarr.create_group(unfinished, attributes=_as_json({**cube.attributes, **cube.findings}))
        for name, variable in cube.variables.items():
            group.create_array(
                name,
                shape=(cube.grid,) * 3,
                chunks=(min(cube.edge, cube.grid),) * 3,
                dtype=variable.dtype,
                fill_value=variable.not_done,
                compressors=ZstdCodec(level=1, checksum=True),
                dimension_names=DIMENSIONS,
                attributes=_as_json(variable.attributes),
            )
        for name, (axis, attributes) in coordinates(cube).items():
            coordinate = group.create_array(
                name, shape=axis.shape, dtype=axis.dtype, dimension_names=(name,), attributes=_as_json(attributes)
            )
            coordinate[:] = axis
        n = -(-cube.grid // cube.edge)
        group.create_array(
            SECONDS_OF_CHUNK,
            shape=(n,) * 3,
            chunks=(1,) * 3,
            dtype=np.float64,
            fill_value=np.nan,
            compressors=None,
            dimension_names=[f"chunk_{name}" for name in DIMENSIONS],
            attributes={"long_name": "duration of every chunk's computation; NaN where it is not done", "units": "s"},
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # consolidated metadata are not in zarr's specification
            zarr.consolidate_metadata(unfinished)
        try:
            os.replace(unfinished, path)
        except OSError:
            if not path.is_dir():  # otherwise another process was faster; later checks find out if it has the same map
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _opened(path: Path) -> zarr.Group:
    with of_extra("maps", "a stored map"):
        import zarr

    if not path.is_dir():  # early versions of zarr create a missing store on opening
        raise InputError(_SOMETHING_ELSE.format(path))
    for file in path.rglob("*"):
        if not (file.is_file() or file.is_dir()):  # reading a device or a pipe would never end
            raise InputError(f"{path}: found {file.relative_to(path)}, which is neither a file nor a folder.")
    try:
        return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
    except UNREADABLE:
        raise InputError(_SOMETHING_ELSE.format(path)) from None


def _arrays_of_same_map(cube: CubeMap, group: zarr.Group, path: Path) -> dict[str, Any]:
    """Return the arrays of a store; raise InputError if it does not hold the same map."""
    stored, expected = dict(group.attrs), _as_json(cube.attributes)
    if not stored.keys() & expected.keys():
        raise InputError(_SOMETHING_ELSE.format(path))
    for key in (*expected, *(key for key in stored if key not in {*expected, *cube.findings})):
        found, wanted = stored.get(key), expected.get(key)
        if found != wanted:
            raise InputError(
                f"{path}: found another map, with {_in_words(key, found, wanted)}: "
                "choose another folder, or remove this one."
            )
    try:
        arrays = {name: group[name] for name in (*cube.variables, SECONDS_OF_CHUNK)}
    except UNREADABLE:
        raise InputError(f"{path}: found an incomplete map: remove it, or choose another folder.") from None
    return arrays


def _check_stated_size(array: Any, file: Path) -> None:
    """Raise ValueError if a chunk compressed by zstd states a wrong size; the decoder would allocate it.

    RFC 8878, section 3.1.1.1, defines the layout of the first bytes.
    """
    if not file.is_file():  # a folder, or no chunk yet
        return
    with file.open("rb") as stream:
        head = stream.read(18)
    if len(head) < 5 or head[:4] != b"\x28\xb5\x2f\xfd":
        return
    single_segment = head[4] >> 5 & 1
    width = (single_segment, 2, 4, 8)[head[4] >> 6]
    begin = 6 - single_segment + (0, 1, 2, 4)[head[4] & 3]
    stated = int.from_bytes(head[begin : begin + width], "little") + (256 if width == 2 else 0)
    expected = math.prod(array.chunks) * array.dtype.itemsize
    if width and stated != expected:
        raise ValueError(f"it states {stated} bytes instead of {expected}")


def _edge(arrays: Mapping[str, Any], marks: FloatArray, path: Path) -> int:
    """Return the number of points along the edges of the store's chunks; a new store may have another one."""
    (shape, chunks), *others = {(array.shape, array.chunks) for array in arrays.values()}
    if others or len({*shape}) != 1 or len({*chunks}) != 1 or marks.shape != (-(-shape[0] // chunks[0]),) * 3:
        raise InputError(f"{path}: found chunks that are not those of a map: remove it, or choose another folder.")
    return int(chunks[0])


def _in_words(key: str, found: Any, wanted: Any) -> str:
    if any(isinstance(value, str) and "\n" in value for value in (found, wanted)):
        return f"another {key}"
    shown = ["none" if value is None else f"{value}" for value in (found, wanted)]
    return f"{key} {shown[0]} instead of {shown[1]}"


def _readable_marks(marks: Any) -> FloatArray:
    """Return the seconds of each chunk that is done; NaN for others, also if the mark itself is damaged."""
    try:
        return np.array(marks[:])
    except UNREADABLE:
        seconds = np.full(marks.shape, np.nan)
        for index in np.ndindex(marks.shape):
            with contextlib.suppress(*UNREADABLE):
                seconds[index] = marks[index]
        return seconds


def _locked(path: Path) -> int | None:
    """Return a descriptor with a lock, which ends when it is closed or the process ends; None without locks."""
    if sys.platform == "win32":
        return None
    import fcntl

    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise InputError(f"{path}: another process is writing to this map.") from None
    except OSError:  # a file system without locks
        os.close(descriptor)
        return None
    return descriptor
