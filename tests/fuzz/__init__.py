"""Fuzz every decoder of foreign bytes: ``python -m tests.fuzz [--seconds N] [TARGET ...]``."""
