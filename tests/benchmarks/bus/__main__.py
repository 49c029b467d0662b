"""Run it: ``smal bench bus``."""

from __future__ import annotations

from tests.benchmarks.bus.benchmark import main
from tests.benchmarks.command_line import run_benchmark

if __name__ == "__main__":
    run_benchmark(main)
