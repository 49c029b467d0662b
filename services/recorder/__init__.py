"""Writes every message of an episode to a crash-safe MCAP file.

Read, in ``services.recordings``, ``encoding`` (what a message looks like in a file), ``chunks`` and ``writer``; then
``service``.
"""
