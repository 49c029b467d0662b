"""Writes every message of an episode to a crash-safe MCAP file, and reads such files back.

Read ``encoding`` (what a message looks like in a file), then ``mcap_writer`` and ``mcap_reader``, then ``service``.
"""
