"""The ``smal`` command, one file a verb."""

from typing import Any, Final

#: Of every group of commands.
STYLE: Final[dict[str, Any]] = {
    "no_args_is_help": True,
    "add_completion": False,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
}
