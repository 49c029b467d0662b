"""Fuzz the decoders: ``python -m tests.fuzz [--seconds N] [TARGET ...]``; exit status 1 where one breaks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.fuzz.campaign import fuzz
from tests.fuzz.targets import CRASHERS, NAMES


def main() -> int:
    """Fuzz one target after the other and print a line for each."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(NAMES)}; all if not given")
    parser.add_argument("--seconds", type=int, default=60, help="for each target (default 60)")
    parser.add_argument("--crashers", type=Path, default=CRASHERS, help="folder for the inputs that break a decoder")
    parser.add_argument("--verbose", action="store_true", help="show all that the fuzzer says")
    asked = parser.parse_args()
    unknown = sorted(set(asked.targets) - set(NAMES))
    if unknown:
        parser.error(f"unknown target {', '.join(unknown)}; known are {', '.join(NAMES)}")
    broken = False
    for name in asked.targets or NAMES:
        campaign = fuzz(name, asked.seconds, asked.crashers)
        sys.stdout.write(f"{campaign.line()}\n{campaign.output if asked.verbose else campaign.finding}")
        sys.stdout.flush()
        broken |= not campaign.clean
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
