"""What was learned as files: one container, and what is stored in it."""
