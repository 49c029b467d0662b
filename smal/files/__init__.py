"""Model files: one container format, and its contents."""
