"""Run it: ``smal bench recognition``."""

from __future__ import annotations

from tests.benchmarks.command_line import run_benchmark
from tests.benchmarks.recognition.benchmark import main

if __name__ == "__main__":
    run_benchmark(main)
