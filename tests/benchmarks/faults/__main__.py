"""Run it: ``smal bench faults``."""

from __future__ import annotations

from tests.benchmarks.command_line import run_benchmark
from tests.benchmarks.faults.benchmark import main

if __name__ == "__main__":
    run_benchmark(main)
