"""Benchmarks: what is fast, by how much, and against what. `python -m tests.benchmarks NAME` runs NAME."""
