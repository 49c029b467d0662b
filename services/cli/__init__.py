"""The ``smal`` command; each subcommand has its own module."""
