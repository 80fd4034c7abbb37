"""How the command lines of `answers` are spelled in the checkout that runs them.

Cases are spelled as in 82dd265. What a checkout no longer knows by its help, a command, a flag or a flag's
value, is replaced by what `_NEW` says; a flag that `_NEW` does not know becomes a key of --config.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

_NEW = {
    "report": "check",
    "--write-to": "--report",
    "--no-adjust": "--adjust none",
    "--bundle-adjust": "--adjust full",
    "--rotations measured": "--rotations held",
    "--rotation-sigma-deg": "--rotations",
    "--refine-intrinsics none": "--intrinsics held",
    "--refine-intrinsics": "--intrinsics",
    "--refine-rigs": "--rigs free",
    "--refine-with-priors": "",
    "--scale prior": "--priors database",
}
"""Today's text and the new one: of a command, a flag, or a flag with a value.

`config:KEY` in place of a flag makes its value that of a key of --config: "--tol": "config:solver.tol".
"""

_DEFINED = re.compile(r"^ +(-.*?)(?:  .*)?$", re.MULTILINE)
"""Of a line that defines a flag: its names and the form of its value."""
_FLAG = re.compile(r"--[\w-]+")
_CHOICES = re.compile(r"(--[\w-]+) [<\[]?([\w.:-]+(?:\|[\w.:-]+)+)")


class Help(NamedTuple):
    """What a command knows, read from its help."""

    flags: frozenset[str]
    choices: dict[str, frozenset[str]]
    """Values of the flags that have a choice."""

    def lacks(self, words: Sequence[str]) -> bool:
        """Return whether a flag, or its value if a second word is given, is unknown."""
        flag, *values = words
        chosen = self.choices.get(flag, frozenset(values))
        return flag not in self.flags or not chosen.issuperset(values)


def read_help(text: str) -> Help:
    """Return the flags that a help defines, and their choices."""
    defined = _DEFINED.findall(text)
    choices = {
        flag: frozenset(values.split("|")) for line in defined for flag, values in _CHOICES.findall(line)
    }
    return Help(frozenset(flag for line in defined for flag in _FLAG.findall(line)), choices)


class Spelling:
    """The spelling of one checkout."""

    def __init__(self, ask: Callable[[list[str]], str]) -> None:
        """Keep what runs a command line and returns its stdout, empty where it fails."""
        self._ask = ask
        self._helps: dict[str, Help | None] = {}

    def spell(self, argv: Sequence[str]) -> tuple[list[str], dict[str, str]] | None:
        """Return the words of a command line and keys for --config; None if the checkout has none for it."""
        command, *words = argv
        known = self._help_of(command)
        if known is None:
            command = _NEW.get(command, command)
            known = self._help_of(command)
        if known is None:
            return None
        spelled, keys = [command], {}
        for part in _parts(words):
            for word in _spell_part(part, known):
                if word.startswith("config:"):
                    key, _, value = word.removeprefix("config:").partition("=")
                    keys[key] = value
                else:
                    spelled.append(word)
        unknown = {word for word in spelled if word.startswith("--")} - known.flags
        if unknown or (keys and "--config" not in known.flags):
            return None
        return spelled, keys

    def _help_of(self, command: str) -> Help | None:
        """Return what a command knows, None if there is none of that name."""
        if command not in self._helps:
            text = self._ask([command, "--help-all"]) or self._ask([command, "--help"])
            self._helps[command] = read_help(text) if text else None
        return self._helps[command]


def _parts(words: Iterable[str]) -> list[list[str]]:
    """Return each flag with the words that follow it, and the words before the first flag one by one."""
    parts: list[list[str]] = []
    for word in words:
        if word.startswith("--") or not parts or not parts[-1][0].startswith("--"):
            parts.append([word])
        else:
            parts[-1].append(word)
    return parts


def _spell_part(part: list[str], known: Help) -> list[str]:
    """Return a flag with its values, or another word, as a command knows it."""
    flag, *values = part
    if not flag.startswith("--"):
        return part
    if " ".join(part[:2]) in _NEW and known.lacks(part[:2]):
        return _NEW[" ".join(part[:2])].split() + part[2:]
    if not known.lacks([flag]):
        return part
    new = _NEW.get(flag, f"config:{flag.removeprefix('--').replace('-', '_')}")
    if not new.startswith("config:"):
        return new.split() + values
    key = new.replace("config:no_", "config:")
    value = "false" if key != new else values[0] if values else "true"
    return [f"{key}={value}"]
