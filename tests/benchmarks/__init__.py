"""Benchmarks: what is fast, by how much, and against what. `smal bench NAME` runs the package NAME of this one.

A package with a ``__main__.py`` is a benchmark; ``benchmark.py`` in it says what it measures. What stands beside the
packages is what benchmarks share, one idea a file.
"""
