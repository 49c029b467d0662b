"""The ``smal`` command, one file a verb."""
