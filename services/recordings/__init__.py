"""Recordings of episodes: format, writing, reading, repair, and demonstrations."""
