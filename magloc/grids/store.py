"""Maps of any size, streamed to a zarr store from which an interrupted one goes on.

The store (zarr version 3, ``xarray.open_zarr`` opens it) has one chunk per box of the cube. A chunk's number in
``seconds_of_chunk`` is written after everything else of it, and marks it as done: whatever happens before, the chunk is
computed again; whatever happens after, it never is. Only one box is in memory at a time.
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
# What zarr and xarray raise for a store that is cut short or damaged depends on the place and the codec.
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
    """The store of one map, open for writing: a context manager that keeps other processes from writing to it.

    Parameters
    ----------
    path : path-like
        The store; made if it does not exist.

    Attributes
    ----------
    unreadable : list of str
        One sentence for every chunk that was done but cannot be read; it is computed again.

    Raises
    ------
    InputError
        The path holds something else, or another map, or another process is writing to it. It is left as it is.
    OSError
        The store cannot be made.
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
        """Let other processes write."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def n_chunks(self) -> int:
        """Chunks of the whole map."""
        return int(self._seconds.size)

    @property
    def chunks_done(self) -> int:
        """Chunks that will not be computed again."""
        return int(np.isfinite(self._seconds).sum())

    def unfinished(self) -> Iterator[Box]:
        """Boxes that are not done."""
        return (box for box in self._boxes() if np.isnan(self._seconds[box.place]))

    def write(self, chunks: Iterable[Chunk], progress: Callable[[int], None] | None = None) -> None:
        """Write chunks as they come; where one cannot be written, those before it are done."""
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
    """Map in a store, loaded piece by piece; NaN, or the smallest integer there is, where a chunk is not done."""
    import xarray as xr

    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*not recognized as a component")  # an array whose description is damaged
        group = _opened(Path(path))
        # One by one: of several that zarr opens at once it retrieves one error, and asyncio prints the others.
        for name in (folder.name for folder in sorted(Path(path).iterdir()) if folder.is_dir()):
            array = group[name]
            for file in Path(path, name, "c").rglob("*"):
                _check_stated_size(array, file)
        dataset = xr.open_zarr(path, chunks=None, consolidated=False)
    seconds = float(dataset[SECONDS_OF_CHUNK].sum())
    dataset = dataset.drop_vars(SECONDS_OF_CHUNK).assign_attrs(seconds=seconds)
    for variable in dataset.data_vars.values():
        if "flag_values" in variable.attrs:  # JSON knows no types, netCDF and CF want that of the variable
            variable.attrs["flag_values"] = np.asarray(variable.attrs["flag_values"], dtype=variable.dtype)
    return dataset


def chunk_seconds(path: str | os.PathLike[str]) -> FloatArray:
    """Duration of every chunk of a store, NaN where it is not done; empty where there is no map."""
    try:
        return _readable_marks(_opened(Path(path))[SECONDS_OF_CHUNK])
    except UNREADABLE:
        return np.empty(0)


def _as_json(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes as they come back from a store."""
    return json.loads(json.dumps(dict(attributes), default=lambda value: value.tolist()))


def _make_store(cube: CubeMap, path: Path) -> None:
    """Make an empty store in one step: an interruption leaves no half of one in its place."""
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
            warnings.simplefilter("ignore")  # not yet in zarr's specification; xarray asks for it, others ignore it
            zarr.consolidate_metadata(unfinished)
        try:
            os.replace(unfinished, path)
        except OSError:
            if not path.is_dir():  # else another process was faster: whose it is, and whether it writes, is seen next
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _opened(path: Path) -> zarr.Group:
    with of_extra("maps", "a stored map"):
        import zarr

    if not path.is_dir():  # early versions of zarr make what they are to open
        raise InputError(_SOMETHING_ELSE.format(path))
    for file in path.rglob("*"):
        if not (file.is_file() or file.is_dir()):  # a device or a pipe would be read without end
            raise InputError(f"{path}: found {file.relative_to(path)}, which is neither a file nor a folder.")
    try:
        return zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
    except UNREADABLE:
        raise InputError(_SOMETHING_ELSE.format(path)) from None


def _arrays_of_same_map(cube: CubeMap, group: zarr.Group, path: Path) -> dict[str, Any]:
    """Arrays of a store that holds this very map."""
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
        raise InputError(
            f"{path}: found a map of which a part is missing: remove it, or choose another folder."
        ) from None
    return arrays


def _check_stated_size(array: Any, file: Path) -> None:
    """Refuse a chunk compressed by zstd that states another size than its own: the decoder allocates what it states.

    The layout of the first bytes is that of RFC 8878, section 3.1.1.1.
    """
    if not file.is_file():  # a folder, or a chunk that is not done
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
        raise ValueError(f"it states {stated} bytes in place of {expected}")


def _edge(arrays: Mapping[str, Any], marks: FloatArray, path: Path) -> int:
    """Points along the edges of the chunks, which are those of the store, whatever a new one would have."""
    (shape, chunks), *others = {(array.shape, array.chunks) for array in arrays.values()}
    if others or len({*shape}) != 1 or len({*chunks}) != 1 or marks.shape != (-(-shape[0] // chunks[0]),) * 3:
        raise InputError(f"{path}: found chunks that are not those of a map: remove it, or choose another folder.")
    return int(chunks[0])


def _in_words(key: str, found: Any, wanted: Any) -> str:
    if any(isinstance(value, str) and "\n" in value for value in (found, wanted)):
        return f"another {key}"
    shown = ["none" if value is None else f"{value}" for value in (found, wanted)]
    return f"{key} {shown[0]} in place of {shown[1]}"


def _readable_marks(marks: Any) -> FloatArray:
    """What is done (seconds) and what is not (NaN, also where the mark itself is damaged)."""
    try:
        return np.array(marks[:])
    except UNREADABLE:
        seconds = np.full(marks.shape, np.nan)
        for index in np.ndindex(marks.shape):
            with contextlib.suppress(*UNREADABLE):
                seconds[index] = marks[index]
        return seconds


def _locked(path: Path) -> int | None:
    """Descriptor that holds a lock until it is closed or the process ends, however it does; None without locks."""
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
