"""The commands of the ``smal`` command line, one a file: `services.cli` has the list.

What a command is made of stands in a package beside it: `episodes` (`run`, `demonstrate`), `evaluation`, `listening`
(`topic`), `matching`, `stack` (all that start processes), `teaching` (`learn`) and `tuning`. What several share stands
in single files.
"""
