"""Print the table of docs/options.md, made from the definitions of the options.

python scripts/options_table.py
"""

from collections.abc import Iterator
from dataclasses import fields

from sfm_shapefit.base.settings import Option, Settings, setting_groups
from sfm_shapefit.cli import app
from sfm_shapefit.cli.flags import brief_help
from sfm_shapefit.facts.command_options import LocateOptions, MapOptions


def homes(settings: type[Settings], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield each option and its table in a file."""
    for item in fields(settings):
        if isinstance(item.default, Settings):
            yield from homes(type(item.default), f"{prefix}{item.name}.")
        else:
            yield item.name, prefix[:-1]


def row(item: Option, home: str, flags: set[str]) -> str:
    """Return the row of an option."""
    default = "" if item.default in ("", ()) else str(item.default)
    name = f"--{item.name.replace('_', '-')}" if item.name in flags else item.name
    return f"| `{name}` | {home} | {default} | {brief_help(item.help)} |"


def table() -> str:
    """Return a row for each option of `locate` and `map`; those that have a flag are spelled as it is."""
    commands = [one.callback for one in app.registered_commands if one.name in {"locate", "map"}]
    flags = {name for command in commands for name in command.__annotations__}
    rows: dict[str, str] = {}
    for settings in (LocateOptions, MapOptions):
        home = dict(homes(settings))
        for group in setting_groups(settings):
            rows |= {item.name: row(item, home[item.name], flags) for item in group.options}
    return "\n".join(
        ["| option | table | default | meaning |", "|---|---|---|---|", *map(rows.get, sorted(rows))]
    )


if __name__ == "__main__":
    print(table())
