"""Zenoh router in a Python process, for machines without zenohd."""
