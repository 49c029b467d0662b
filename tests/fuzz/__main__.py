"""Fuzz one decoder with Atheris: ``python -m tests.fuzz model -max_total_time=60``; flags are libFuzzer's.

It ends with status 0, or at an input that breaks the decoder, which it writes beside ``-artifact_prefix=``.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

import atheris

from tests.fuzz.targets import CRASHERS, LONGEST_INPUT, NAMES, Target, crashers_of, load

#: What is watched for new branches: the decoders and the Python that they are made of.
_PACKAGES = ["schemas", "services", "smal", "mcap"]
#: An input that takes longer, or a process that grows larger, is a finding.
_LIMITS = ["-timeout=10", "-rss_limit_mb=1024", f"-max_len={LONGEST_INPUT}"]


def main(name: str, flags: list[str]) -> None:
    """Fuzz until libFuzzer ends the process."""
    with atheris.instrument_imports(include=_PACKAGES):
        target = load(name)
    kept = CRASHERS / name
    kept.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as corpus:
        inputs = [*target.seeds(), *(path.read_bytes() for path in crashers_of(name))]
        for number, data in enumerate(inputs):
            (Path(corpus) / str(number)).write_bytes(data)
        given = [sys.argv[0], f"-artifact_prefix={kept}/", *_LIMITS, *flags, corpus]
        atheris.Setup(given, _silent(target), custom_mutator=_mutator(target))
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
    if sys.argv[1:2] and sys.argv[1] in NAMES:
        main(sys.argv[1], sys.argv[2:])
    else:
        sys.exit(f"{__doc__}\nDecoders: {', '.join(NAMES)}")
