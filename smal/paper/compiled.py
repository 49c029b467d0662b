"""Compilation of inner loops to machine code (numba).

Measured before the dependency was taken: the product of 10,000 templates of 4,096 entries with 10 vectors takes a
third of BLAS's time (BLAS repacks the templates for a narrow product), and the Newton solver a tenth of numpy's (its
arrays are small).
"""

import os
import shutil
from collections.abc import Callable
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

# Sums may be reordered, which vector instructions need; NaN and infinity keep their meaning.
_FAST_MATH = {"reassoc", "contract", "nsz"}
#: What each compiled function is made of: its file, those of the functions that it calls, and the numbers that it uses.
_made_of: dict[Any, frozenset[str]] = {}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of arrays and numbers at its first call, and keep the machine code on disk.

    Where its folder (`NUMBA_CACHE_DIR` names one) can be read only, what is there is used. What is not, each process
    compiles for itself, which costs its start up to a minute and nothing else. The global interpreter lock is released
    while it runs.
    """
    compiler = partial(numba.njit, fastmath=_FAST_MATH, nogil=True, error_model="numpy")
    file = function.__code__.co_filename
    parts = {_contents(file)} | _used_by(function)
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(file).parent / "__pycache__")
    # A function becomes part of those that call it, and numba looks at their own file alone: what is kept is kept by
    # all that it is made of.
    folder /= sha256("".join(sorted(parts)).encode()).hexdigest()[:12]
    config: Any = numba.config
    usual = config.CACHE_DIR
    try:
        folder.mkdir(parents=True, exist_ok=True)
        config.CACHE_DIR = str(folder if os.access(folder, os.W_OK) else _copied(folder))
        made = compiler(cache=True)(function)
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "cannot cache" not in str(error):
            raise
        made = compiler()(function)
    finally:
        config.CACHE_DIR = usual
    _made_of[made] = frozenset(parts)
    return cast("Callable[P, R]", made)


def _copied(folder: Path) -> Path:
    """Copy a folder to where this process can write: numba reads from no folder that it cannot write to."""
    return Path(shutil.copytree(folder, Path(_own_folder().name) / folder.name, dirs_exist_ok=True))


@lru_cache
def _own_folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="smal-compiled-")


@lru_cache
def _contents(file: str) -> str:
    return sha256(Path(file).read_bytes()).hexdigest()


def _used_by(function: Any) -> set[str]:  # noqa: ANN401 - a function's insides have no type
    values = [function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__]
    calls = [_made_of[one] for one in values if callable(one) and one in _made_of]
    return {repr(one) for one in values if isinstance(one, int | float)}.union(*calls)
