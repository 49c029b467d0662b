"""Writes every message of an episode to a crash-safe MCAP file; what is in it, ``services.recordings.encoding``."""
