"""Fuzz one decoder with Atheris: ``python -m tests.fuzz model -max_total_time=60``; flags are libFuzzer's.

It ends with status 0, or at an input that breaks the decoder, which it writes beside ``-artifact_prefix=``.
"""

import sys
import tempfile
from pathlib import Path

import atheris

# What is watched for new branches: the decoders and the Python that they are made of.
with atheris.instrument_imports(include=["schemas", "services", "smal", "mcap"]):
    from tests.fuzz.targets import CRASHERS, LONGEST_INPUT, TARGETS, crashers_of


def main(name: str, flags: list[str]) -> None:
    """Fuzz until libFuzzer ends the process."""
    target = TARGETS[name]
    kept = CRASHERS / name
    kept.mkdir(exist_ok=True)

    def run(data: bytes) -> None:
        target.run(data)

    with tempfile.TemporaryDirectory() as corpus:
        for number, data in enumerate(
            [*target.seeds(), *(path.read_bytes() for path in crashers_of(name))]
        ):
            (Path(corpus) / str(number)).write_bytes(data)
        # An input that takes longer, or a process that grows larger, is a finding.
        limits = [
            "-timeout=10",
            "-rss_limit_mb=1024",
            f"-max_len={LONGEST_INPUT}",
            f"-artifact_prefix={kept}/",
        ]
        atheris.Setup([sys.argv[0], *limits, *flags, corpus], run)
        atheris.Fuzz()


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in TARGETS:
        main(sys.argv[1], sys.argv[2:])
    else:
        sys.exit(f"{__doc__}\nDecoders: {', '.join(TARGETS)}")
