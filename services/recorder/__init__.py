"""Recorder: writes every message of an episode to a crash-safe MCAP file."""
