"""Compilation of inner loops to machine code (numba).

Measured before the dependency was taken: the product of 10,000 templates of 4,096 entries with 10 vectors takes a
third of BLAS's time in float32 and a fifth from int8 (BLAS repacks the templates for a narrow product, and numpy
has no fast int8 product), and the Newton solver a tenth of numpy's (its arrays are small).
"""

from collections.abc import Callable
from functools import partial
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

# Sums may be reordered, which vector instructions need; NaN and infinity keep their meaning.
_FAST_MATH = {"reassoc", "contract", "nsz"}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of arrays and numbers at its first call, and keep the machine code on disk.

    Where no folder for it can be written (`NUMBA_CACHE_DIR` names one), each process compiles for itself, which
    costs its start a few seconds and nothing else. The global interpreter lock is released while it runs.
    """
    compiler = partial(numba.njit, fastmath=_FAST_MATH, nogil=True, error_model="numpy")
    try:
        return cast("Callable[P, R]", compiler(cache=True)(function))
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        return cast("Callable[P, R]", compiler()(function))
