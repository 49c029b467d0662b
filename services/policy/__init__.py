"""States in, decisions and commands out."""
