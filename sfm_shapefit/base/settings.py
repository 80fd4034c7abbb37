"""Settings of any stage: dataclasses whose fields carry their sentence, so that it is written once.

The command line's flags, the keys of its TOML file, `help()`, the JSON Schema and the table in
`docs/options.md` are all made of these fields.

    @explained
    @dataclass(frozen=True, kw_only=True)
    class SolverOptions(Settings):
        "How the program is solved."

        tol: float = option(1e-8, "Certified gap at which a solve counts as converged.")
"""

import difflib
import inspect
import numbers
import textwrap
import types
from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

S = TypeVar("S", bound="Settings")

_HELP_WIDTH = 88  # columns; the text of the help as it stands indented on a terminal


def option(default: Any, help: str, *, also: str = "") -> Any:  # noqa: A002  as click and argparse call it
    """Return a field with its default and its sentence; `also` is an earlier name that flags still take."""
    return field(default=default, metadata={"help": help, "also": also})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Fields made by `option`. Values of another type than the field's are refused by name."""

    def __post_init__(self) -> None:
        kinds = _hints(type(self))  # type: ignore[arg-type]  # a class can be hashed
        for item in fields(self):
            value, kind = getattr(self, item.name), kinds[item.name]
            if value is not item.default and not _fits(value, kind):  # most are the defaults
                raise ValueError(f"{item.name} must be {_wanted(kind)}, got {value!r}")

    def check_range(self, name: str, low: float, high: float = float("inf")) -> None:
        """Raise ValueError, which names the field, if its value lies outside [low, high]."""
        value = getattr(self, name)
        if not low <= value <= high:
            limits = f"be at least {low:g}" if high == float("inf") else f"lie in [{low:g}, {high:g}]"
            raise ValueError(f"{name} must {limits}, got {value}")


class Group(NamedTuple):
    """The fields that one settings class states itself, and what they are about."""

    title: str
    fields: tuple[Field[Any], ...]


def setting_groups(settings: type[Settings]) -> Iterator[Group]:
    """Yield the fields of a settings class, grouped by the class that states them, its own first.

    The title of a group is the first sentence of that class. A field that is stated again, with another
    default, belongs to the class that states it last.
    """
    by_name, seen = {item.name: item for item in fields(settings)}, set[str]()
    for base in settings.__mro__:
        names = [name for name in inspect.get_annotations(base) if name in by_name.keys() - seen]
        seen |= set(names)
        if names:
            title = (base.__doc__ or base.__name__).split("\n")[0].rstrip(".")
            yield Group(title, tuple(by_name[name] for name in names))


def explained(settings: type[S]) -> type[S]:
    """Add the options of a settings class, with defaults and sentences, to its docstring."""
    lines = [(settings.__doc__ or "").rstrip(), "", "Options:"]
    for group in setting_groups(settings):
        for item in group.fields:
            sentence = textwrap.wrap(item.metadata["help"], _HELP_WIDTH)
            lines += [f"    {item.name} = {item.default!r}", *(f"        {line}" for line in sentence)]
    settings.__doc__ = "\n".join(lines)
    return settings


def merge_options(given: S | None, settings: type[S], overrides: dict[str, Any]) -> S:
    """Return the settings of a call: those given, or the defaults, with single options set by keyword.

    TypeError for other settings, or a keyword that is no option; ValueError for a value that is refused.
    """
    if given is not None and not isinstance(given, settings):
        kind, wanted = type(given).__name__, settings.__name__
        raise TypeError(f"options must be {wanted}(...), got a {kind}; or give single options by keyword")
    names = [item.name for item in fields(settings)]
    for name in overrides:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(names)}"
            raise TypeError(f"{name!r} is no option of {settings.__name__}; {hint}")
    if given is None:
        return settings(**overrides)
    return replace(given, **overrides) if overrides else given


# The types of a settings class's fields by name.
_hints = cache(get_type_hints)


_KINDS: dict[Any, tuple[type, ...]] = {
    int: (numbers.Integral,),
    float: (numbers.Real,),
    str: (str,),
    bool: (bool,),
    tuple: (tuple, list),
    Path: (Path,),
}


def _fits(value: object, kind: Any) -> bool:
    """Tell whether a value is of a field's type; an integer serves as a float, a list as a tuple."""
    if get_origin(kind) in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in get_args(kind))
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if kind is type(None):
        return value is None
    accepted = _KINDS[get_origin(kind) or kind]
    return isinstance(value, accepted) and (kind is bool or not isinstance(value, bool))


def _wanted(kind: Any) -> str:
    """Say what a field takes."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_wanted(choice) for choice in get_args(kind) if choice is not type(None))
    return f"of type {(get_origin(kind) or kind).__name__}"
