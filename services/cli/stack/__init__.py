"""The processes of a stack that a command starts."""
