"""One thread of linear algebra: over matrices as small as ours, BLAS's threads do little but wait for each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np  # noqa: F401 - it and scipy.linalg each load a BLAS of their own
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])
_BLAS = ThreadpoolController().select(user_api="blas").lib_controllers


def one_blas_thread(function: Function) -> Function:
    """Give a function one thread of BLAS while it runs, and the process its own number back."""

    @wraps(function)
    def limited(*arguments: Any, **options: Any) -> Any:
        # threadpoolctl's own decorator asks and sets in any case: a tenth of a fix.
        several = [(library, n) for library in _BLAS if (n := library.get_num_threads()) != 1]
        for library, _ in several:
            library.set_num_threads(1)
        try:
            return function(*arguments, **options)
        finally:
            for library, n in several:
                library.set_num_threads(n)

    return cast(Function, limited)
