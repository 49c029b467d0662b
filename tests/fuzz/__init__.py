"""Every decoder of a stranger's bytes is fuzzed: ``python -m tests.fuzz [--seconds N] [TARGET ...]``."""
