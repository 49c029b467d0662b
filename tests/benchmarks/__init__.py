"""Benchmarks: what is fast, by how much, and against what. `smal bench NAME` runs the module NAME of this package.

A module that can be run (it ends with ``if __name__ == "__main__"``) is a benchmark; its docstring's first line says
what it measures. The other modules are what benchmarks share, one idea a file.
"""
