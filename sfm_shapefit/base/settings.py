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
import numbers
import textwrap
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

S = TypeVar("S", bound="Settings")

_COLORS = "points get colors when a result is written: found.write(folder, images=...)"
_HELP_WIDTH = 88  # columns; the text of the help as it stands indented on a terminal


def option(default: Any, help: str) -> Any:  # noqa: A002  as click and argparse call it
    """Return a field with its default and its sentence."""
    return field(default=default, metadata={"help": help})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Fields made by `option`. Values of another type than the field's are refused by name."""

    def __post_init__(self) -> None:
        kinds = _hints(type(self))  # type: ignore[arg-type]  # a class can be hashed
        for item in fields(self):
            value, kind = getattr(self, item.name), kinds[item.name]
            if value is not item.default and not _fits(value, kind):  # most are the defaults
                raise ValueError(f"{item.name} must be {_wanted(kind)}, got {value!r}")
            if float in (kind, *get_args(kind)) and isinstance(value, numbers.Integral):
                object.__setattr__(self, item.name, float(value))  # kernels are compiled by types

    def check_range(self, name: str, low: float, high: float = float("inf")) -> None:
        """Raise ValueError, which names the field, if its value lies outside [low, high]."""
        value = getattr(self, name)
        if not low <= value <= high:
            limits = f"be at least {low:g}" if high == float("inf") else f"lie in [{low:g}, {high:g}]"
            raise ValueError(f"{name} must {limits}, got {value}")


@dataclass(frozen=True, kw_only=True, init=False)
class Composed(Settings):
    """Settings that hold groups of settings; options of the groups may be given as if they were its own.

        LocateOptions(min_trust=0.0, directions=DirectionOptions(min_inliers=20))
        LocateOptions(directions={"min_inliers": 20})          # a table of TOML

    A subclass is a dataclass with `init=False`.
    """

    def __init__(self, **given: Any) -> None:
        """Take groups by their name, and single options, which win, by theirs.

        Raises:
            TypeError: if a name is no option; the message says what is.
            ValueError: if a value is refused.
        """
        homes = homes_of(type(self))
        values: dict[str, Any] = {item.name: item.default for item in fields(self)}
        for name in values.keys() & given.keys():
            kind = type(values[name])
            if issubclass(kind, Settings) and isinstance(given[name], kind):
                values[name] = given.pop(name)
            elif issubclass(kind, Settings) and isinstance(given[name], Mapping):
                values[name] = merge_options(values[name], kind, given.pop(name))
        single: dict[str, dict[str, Any]] = {}
        for name, value in given.items():
            if name not in homes:
                said = f"give {type(values[name]).__name__}(...)" if name in values else hint(name, homes)
                raise TypeError(f"{name!r} is no option of {type(self).__name__}; {said}")
            single.setdefault(homes[name], {})[name] = value
        for home, some in single.items():
            values[home] = replace(values[home], **some) if isinstance(values[home], Settings) else some[home]
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self.__post_init__()


def group(settings: type[Settings], **defaults: Any) -> Any:
    """Return a field of a composed class that holds a group, with these defaults in place of its own."""
    return field(default=settings(**defaults))


class Option(NamedTuple):
    """A single option: what `option` states of it, and the type of its values."""

    name: str
    default: Any
    help: str
    kind: Any


class OptionGroup(NamedTuple):
    """The single options that one settings class states itself, and what they are about."""

    title: str
    options: tuple[Option, ...]


def setting_groups(settings: type[S], defaults: S | None = None) -> Iterator[OptionGroup]:
    """Yield the options of a settings class: its own first, then those of its groups.

    The title of a group is the first sentence of its class.
    """
    kinds, inside, own = _hints(settings), [], []  # type: ignore[arg-type]  # a class can be hashed
    for item in fields(settings):
        value = item.default if defaults is None else getattr(defaults, item.name)
        if isinstance(value, Settings):
            inside.append(value)
        else:
            said = item.metadata
            own.append(Option(item.name, value, said["help"], kinds[item.name]))
    if own:
        yield OptionGroup((settings.__doc__ or settings.__name__).split("\n")[0].rstrip("."), tuple(own))
    for value in inside:
        yield from setting_groups(type(value), value)


def homes_of(settings: type[Settings]) -> dict[str, str]:
    """Return the field that holds each single option: itself, or the group that it stands in.

    Raises:
        TypeError: if two groups have an option of the same name, so that it has no home.
    """
    homes: dict[str, str] = {}
    for item in fields(settings):
        inner = homes_of(type(item.default)) if isinstance(item.default, Settings) else (item.name,)
        if twice := homes.keys() & set(inner):
            raise TypeError(f"{settings.__name__} has several options named {', '.join(sorted(twice))}")
        homes |= dict.fromkeys(inner, item.name)
    return homes


def flat_values(settings: Settings) -> dict[str, Any]:
    """Return the values of all single options by name, those of groups among them."""
    values = {item.name: getattr(settings, item.name) for item in fields(settings)}
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flat_values(value) if isinstance(value, Settings) else {name: value}
    return flat


def explained(settings: type[S]) -> type[S]:
    """Add the options of a settings class, with defaults and sentences, to its docstring."""
    lines = [(settings.__doc__ or "").rstrip(), "", "Options:"]
    for one in setting_groups(settings):
        for item in one.options:
            sentence = textwrap.wrap(item.help, _HELP_WIDTH)
            lines += [f"    {item.name} = {item.default!r}", *(f"        {line}" for line in sentence)]
    settings.__doc__ = "\n".join(lines)
    return settings


def hint(name: str, known: Iterable[str]) -> str:
    """Say what a name that is not known may stand for, or which other settings have it."""
    owners = {
        one.__name__: None
        for one in Composed.__subclasses__()
        if any(name == item.name for inside in setting_groups(one) for item in inside.options)
    }
    if owners:
        return f"it is one of {', '.join(owners)}"
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"


def merge_options(given: S | None, settings: type[S], overrides: Mapping[str, Any]) -> S:
    """Return the settings of a call: those given, or the defaults, with single options set by keyword.

    TypeError for other settings, or a keyword that is no option; ValueError for a value that is refused.
    """
    if given is not None and not isinstance(given, settings):
        kind, wanted = type(given).__name__, settings.__name__
        raise TypeError(f"options must be {wanted}(...), got {kind}; or give single options by keyword")
    known = homes_of(settings)
    for name in overrides:
        if name not in known and name not in known.values():
            said = _COLORS if name == "images" else hint(name, known)
            raise TypeError(f"{name!r} is no option of {settings.__name__}; {said}")
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
_NAMES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    tuple: "a list",
    Path: "a path",
}


def _fits(value: object, kind: Any) -> bool:
    """Tell whether a value is of a field's type; an integer serves as a float, a list as a tuple."""
    if get_origin(kind) in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in get_args(kind))
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if kind is type(None):
        return value is None
    if isinstance(kind, type) and issubclass(kind, Settings):
        return isinstance(value, kind)
    accepted = _KINDS[get_origin(kind) or kind]
    return isinstance(value, accepted) and (kind is bool or not isinstance(value, bool))


def _wanted(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_wanted(choice) for choice in get_args(kind) if choice is not type(None))
    kind = get_origin(kind) or kind
    return _NAMES.get(kind) or f"of type {kind.__name__}"
