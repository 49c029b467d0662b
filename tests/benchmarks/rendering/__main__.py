"""Run it: ``smal bench rendering``."""

from __future__ import annotations

from tests.benchmarks.command_line import run_benchmark
from tests.benchmarks.rendering.benchmark import main

if __name__ == "__main__":
    run_benchmark(main)
