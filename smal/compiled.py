"""Compilation of inner loops to machine code (numba).

Measured before the dependency was taken: the product of 10,000 templates of 4,096 entries with 10 vectors takes a
third of BLAS's time in float32 and a fifth from int8 (BLAS repacks the templates for a narrow product, and numpy
has no fast int8 product), and the Newton solver a tenth of numpy's (its arrays are small).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core.dispatcher import Dispatcher

_Compiled: Any = Dispatcher
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
        kept = compiler(cache=True)(function)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        return cast("Callable[P, R]", compiler()(function))
    if isinstance(kept, _Compiled):  # under NUMBA_DISABLE_JIT it is the function itself
        _renew_with_what_it_uses(kept)
    return cast("Callable[P, R]", kept)


def _renew_with_what_it_uses(kept: Any) -> None:  # noqa: ANN401 - numba's dispatchers have no type
    """Compile a function anew also where another file changed, of which it uses compiled functions or numbers.

    Both become part of its machine code, but numba only asks whether the function's own file has changed.
    """
    names, values = kept.py_func.__code__.co_names, kept.py_func.__globals__
    used: list[Any] = [values[name] for name in names if name in values]
    files = [getattr(one._cache, "_cache_file", None) for one in used if isinstance(one, _Compiled)]
    stamps = [one._source_stamp for one in files if one is not None]
    file = kept._cache._cache_file
    file._source_stamp = (file._source_stamp, stamps, [one for one in used if isinstance(one, int | float)])
