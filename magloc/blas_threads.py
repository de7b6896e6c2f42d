"""One thread of linear algebra: over matrices as small as ours, BLAS's threads do little but wait for each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np  # noqa: F401 - it and scipy.linalg each load a BLAS of their own
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])
_LIMIT = ThreadpoolController().wrap(limits=1, user_api="blas")


def one_blas_thread(function: Function) -> Function:
    """Give a function one thread of BLAS while it runs, and the process its own number back."""
    return cast(Function, _LIMIT(function))
