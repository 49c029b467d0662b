"""Recordings of episodes: format, writing, reading, recovery, and the demonstrations in them."""
