"""Earlier spellings of options and values, accepted with a warning until version 0.3."""

import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from typer import BadParameter
from typer.core import TyperCommand

RENAMED_OPTIONS: Mapping[str, str] = {
    "--arm": "--cell-override",
    "--catalogue": "--catalog",
    "--count": "--max-scenes",
    "--laid-out": "--initial-poses",
}
"""Current option by its earlier spelling, for every command that has only the current one."""
RENAMED_VALUES: Mapping[str, Mapping[str, str]] = {"--fidelity": {"fast": "static_or_drake"}}
"""Current value by its earlier spelling, of each option."""

_PYDANTIC_PREFIX = "Value error, "
"""What pydantic writes before the message of a validator, and Typer 0.29 passes on."""


class RenamingCommand(TyperCommand):
    """A command that accepts earlier spellings, which its help does not show."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments after the replacement of earlier spellings."""
        options = {name for parameter in self.params for name in parameter.opts}
        try:
            return super().parse_args(ctx, list(with_current_spellings(options, args)))
        except BadParameter as error:
            error.message = error.message.removeprefix(_PYDANTIC_PREFIX)
            raise


def with_current_spellings(options: Collection[str], args: Iterable[str]) -> Iterator[str]:
    """Yield a command's arguments in their current spelling; warn on standard error.

    Args:
        options: Current options of the command, which take precedence over earlier spellings.
        args: Arguments after the command's name, such as `["--catalogue=my_objects"]`.
    """
    option = ""
    for argument in args:
        if not argument.startswith("--"):
            yield _current_value(option, argument)
            option = ""
            continue
        option, equals, value = argument.partition("=")
        current = RENAMED_OPTIONS.get(option, option)
        if option not in options and current in options:
            _warn(option, current)
            option = current
        yield option + equals + _current_value(option, value)


def _current_value(option: str, text: str) -> str:
    """Return the current spelling of an option's value, or of each of those in a list."""
    renamed = RENAMED_VALUES.get(option, {})
    values = text.split(",")
    for old in sorted(set(values) & renamed.keys()):
        _warn(f"{option} {old}", f"{option} {renamed[old]}")
    return ",".join(renamed.get(value, value) for value in values)


def _warn(old: str, new: str) -> None:
    message = f"warning: {old} is now {new}; the old spelling is accepted until version 0.3"
    print(message, file=sys.stderr)
