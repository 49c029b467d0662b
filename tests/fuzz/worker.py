"""One target under atheris, in a process that libFuzzer ends: ``python -m tests.fuzz.worker TARGET [FLAG ...]``."""

from __future__ import annotations

import os
import random
import sys
import tempfile
from pathlib import Path

# Instrumented code cannot be compiled by numba.
os.environ["NUMBA_DISABLE_JIT"] = "1"

import atheris

from tests.fuzz.targets import Target, crashers_of, load

#: What is watched for new branches: the decoders and the Python that they are made of.
_PACKAGES = ["schemas", "services", "smal", "mcap"]


def main(name: str, flags: list[str]) -> None:
    """Fuzz until libFuzzer ends the process: at a flag's limit, or at an input that breaks the decoder."""
    with atheris.instrument_imports(include=_PACKAGES):
        target = load(name)
    with tempfile.TemporaryDirectory() as corpus:
        inputs = [*target.seeds(), *(path.read_bytes() for path in crashers_of(name))]
        for number, data in enumerate(inputs):
            (Path(corpus) / str(number)).write_bytes(data)
        atheris.Setup([sys.argv[0], *flags, corpus], _silent(target), custom_mutator=_mutator(target))
        atheris.Fuzz()


def _silent(target: Target):  # noqa: ANN202 - what atheris takes
    def run(data: bytes) -> None:
        target.run(data)

    return run


def _mutator(target: Target):  # noqa: ANN202 - what atheris takes
    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = random.Random(seed)  # noqa: S311
        changed = target.mutate(bytes(data), rng) if rng.random() < 0.8 else None
        if changed is None or len(changed) > max_size:
            return bytes(atheris.Mutate(data, max_size))
        return changed

    return mutate


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
