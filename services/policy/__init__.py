"""Planning: states in, decisions and commands out."""
