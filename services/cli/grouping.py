"""Shared style of the commands, and options in dataclasses."""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import wraps
from typing import Any, Final

#: For every group of commands.
STYLE: Final[dict[str, Any]] = {
    "no_args_is_help": True,
    "add_completion": False,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
}


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Expand the dataclass parameters of a command into single options for Typer."""
    signature = inspect.signature(command, eval_str=True)
    taken = signature.parameters.items()
    groups: dict[str, Any] = {
        name: one.annotation for name, one in taken if is_dataclass(one.annotation)
    }

    @wraps(command)
    def run(**given: Any) -> None:  # noqa: ANN401
        for name, group in groups.items():
            given[name] = group(
                **{option: given.pop(option) for option in inspect.signature(group).parameters}
            )
        command(**given)

    options: list[inspect.Parameter] = []
    for name, one in taken:
        group = groups.get(name)
        options.extend(
            [one] if group is None else inspect.signature(group, eval_str=True).parameters.values()
        )
    keywords = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in options]
    run.__signature__ = signature.replace(parameters=keywords)  # type: ignore[attr-defined]
    return run
