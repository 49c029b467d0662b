"""Shared parts of all services: the bus, the process, its settings, health and metrics."""
