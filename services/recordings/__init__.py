"""Recordings of episodes: their format, writing, reading, recovery, and the drives that they teach."""
