"""Episodes that a command has run: asked for, recorded, and shown."""
