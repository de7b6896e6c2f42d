"""Types that all packages share; numpy is loaded with the first of them that needs it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]
    IntArray = NDArray[np.intp]
    ByteArray = NDArray[np.uint8]
    ComplexArray = NDArray[np.complex128]
    Rng = int | np.integer | np.random.SeedSequence | np.random.BitGenerator | np.random.Generator | None

Vector = tuple[float, float, float]
_SCALARS = {
    "FloatArray": "float64",
    "BoolArray": "bool_",
    "IntArray": "intp",
    "ByteArray": "uint8",
    "ComplexArray": "complex128",
}


def __getattr__(name: str) -> object:
    if name not in (*_SCALARS, "Rng"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import numpy as np
    from numpy.typing import NDArray

    if name == "Rng":
        return int | np.integer | np.random.SeedSequence | np.random.BitGenerator | np.random.Generator | None
    return NDArray[getattr(np, _SCALARS[name])]  # type: ignore[misc]
