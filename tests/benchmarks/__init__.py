"""Benchmarks: what is fast, by how much, and against what. `smal bench NAME` runs the package NAME of this one.

A package with a ``benchmark.py`` is a benchmark; it says what it measures. What stands beside the
packages is what benchmarks share, one idea a file.
"""
