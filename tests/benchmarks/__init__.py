"""Benchmarks: what is fast, by how much, and against what. `smal bench NAME` runs the package NAME of this one."""
