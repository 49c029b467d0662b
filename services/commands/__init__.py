"""The commands of the ``smal`` command line, one a file."""
