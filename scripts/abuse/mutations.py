"""Ways to damage one file: its bytes, its fields, its words, its place in the file system.

Each takes what it needs of a sound file and a generator, and returns the damaged bytes.
"""

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from numpy.random import Generator

from abuse.layouts import Field, words


class Case(NamedTuple):
    """A damaged input and how it is used."""

    label: str
    """What was damaged and how."""
    arguments: tuple[str, ...]
    """Of the command line, relative to the case's folder."""
    same_answer: bool = False
    """Whether the positions must be those of the sound input, since the damage does not concern them."""


INTEGERS = (
    *(0, 1, 2, 7, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**32),
    *(2**62, 2**63 - 1, 2**63, 2**64 - 2, 2**64 - 1),
)
DOUBLES = (
    *(float("nan"), float("inf"), float("-inf"), 0.0, -0.0, -1.0, 1e-300, 5e-324),
    *(1e300, 1.7e308, -1.7e308, 1e155, 1e20, -1e9, 3.5e38, 1e-40, 0.5),
)
WORDS = (
    *("nan", "NaN", "inf", "-inf", "1e400", "-1e400", "0", "-0", "-1", "1", "1.5", "0x10", "1_000", "--5"),
    *("9223372036854775808", "18446744073709551615", "18446744073709551616", "4294967296", "+", "-", "#"),
    *("9" * 400, "9" * 5000, "1e-320", "1e308", "1,5", "PINHOLE", "NONSENSE", "''", "\x00", "\ufeff", "١٢"),
    *("½", "../../../x", "/etc/passwd", "<script>alert(1)</script>", "a" * 10_000, "é\u202e\u0301", "true"),
    "None",
)
HOSTILE_NAMES = (
    *(b"../../outside.jpg", b"/absolute.jpg", b"a/b/../c.jpg", b"C:\\x\\y.jpg", b"line\nbreak.jpg"),
    *(b"tab\t.jpg", b"<script>alert(1)</script>.jpg", b'"quoted",;\'.jpg', b'=HYPERLINK("x")', b"-rf"),
    *(b"--help", b" ", b"."),
    *(b"\x1b[31mred\x1b[2J.jpg", b"\r\n\r\n", b"%s%n%d{0}{name}.jpg", b"[bold]x[/bold].jpg", b"n" * 10_000),
    *("\u202egpj.exe".encode(), "é".encode(), "e\u0301".encode(), "\U0001f4f7.jpg".encode()),
    *("\u2028.jpg".encode(), b"'; DROP TABLE images"),
)
BROKEN_NAMES = (b"\xff\xfe.jpg", b"\xed\xb2\x80.jpg", b"\xc0\xaf.jpg", b"caf\xe9.jpg", b"\xf5\x80\x80\x80")
"""No UTF-8: a stray byte, a surrogate, an overlong slash, Latin-1, beyond the last code point."""


def pick(rng: Generator, items: Sequence[Any]) -> Any:
    """Return one of the items as it is; numpy's `choice` would make an array of them."""
    return items[int(rng.integers(len(items)))]


def change_bytes(data: bytes, rng: Generator) -> bytes:
    """Flip, insert, remove, repeat or blank a few bytes anywhere."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        at, length = int(rng.integers(len(changed) + 1)), int(rng.integers(1, 17))
        match int(rng.integers(6)):
            case 0 if at < len(changed):
                changed[at] ^= int(rng.integers(1, 256))
            case 1:
                changed[at:at] = rng.bytes(length)
            case 2:
                del changed[at : at + length]
            case 3:
                changed[at:at] = changed[at : at + length]
            case 4:
                changed[at : at + length] = b"\xff" * len(changed[at : at + length])
            case _:
                changed[at : at + length] = b"\0" * len(changed[at : at + length])
    return bytes(changed)


def cut_at_field(data: bytes, fields: Sequence[Field], rng: Generator) -> bytes:
    """End the file at the boundary of a field, or a byte before or after it."""
    field = pick(rng, fields)
    return data[: max(field.offset + int(rng.integers(-1, 2)), 0)]


def change_fields(data: bytes, fields: Sequence[Field], rng: Generator) -> bytes:
    """Give one to three fields values that nobody expects; rare meanings are as likely as frequent ones."""
    changed = bytearray(data)
    meanings = sorted({field.meaning for field in fields})
    chosen = []
    for _ in range(int(rng.integers(1, 4))):
        meaning = pick(rng, meanings)
        chosen.append(pick(rng, [field for field in fields if field.meaning == meaning]))
    for field in sorted(chosen, key=lambda field: -field.offset):
        changed[field.offset : field.offset + field.size] = _value(field, rng)
    return bytes(changed)


def _value(field: Field, rng: Generator) -> bytes:
    if field.kind == "name":
        return bytes(pick(rng, (*HOSTILE_NAMES, *BROKEN_NAMES, b""))) + b"\0"
    if field.kind == "d":
        return struct.pack("<d", pick(rng, DOUBLES))
    value = int(pick(rng, INTEGERS)) % 256**field.size
    return value.to_bytes(field.size, "little")


def shuffle_fields(data: bytes, fields: Sequence[Field], rng: Generator) -> bytes:
    """Remove a field, write it twice, or exchange two; lengths may then no longer fit."""
    first, second = pick(rng, fields), pick(rng, fields)
    own = data[first.offset : first.offset + first.size]
    end = first.offset + first.size
    match int(rng.integers(3)):
        case 0:
            return data[: first.offset] + data[end:]
        case 1:
            return data[:end] + own + data[end:]
        case _:
            changed = bytearray(data)
            size = min(first.size, second.size)
            changed[second.offset : second.offset + size] = own[:size]
            return bytes(changed)


def change_words(data: bytes, rng: Generator) -> bytes:
    """Replace, remove, repeat or exchange a few words of a text file."""
    for _ in range(int(rng.integers(1, 4))):
        spans = words(data)
        if not spans:
            return data
        start, end = pick(rng, spans)
        other = data[slice(*pick(rng, spans))]
        hostile = str(pick(rng, WORDS)).encode()
        new = pick(rng, (hostile, hostile, hostile, b"", data[start:end] + b" " + data[start:end], other))
        data = data[:start] + new + data[end:]
    return data


def change_lines(data: bytes, rng: Generator) -> bytes:
    """Remove, repeat, exchange or cut lines, or change what ends them."""
    lines = data.splitlines(keepends=True)
    at = int(rng.integers(len(lines)))
    match int(rng.integers(7)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[at])
        case 2:
            other = int(rng.integers(len(lines)))
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            return b"".join(lines[:at])
        case 4:
            return data.replace(b"\n", pick(rng, (b"\r\n", b"\r", b"\0", b"\n\n", b" ", b"\x85")))
        case 5:
            lines[at] = pick(rng, (b"\n", b"#\n", b" \t\n", b"\xff\xfe\n", b"1 " * 20_000 + b"\n"))
        case _:
            return pick(rng, (b"\xef\xbb\xbf", b"\xff\xfe", b"\0" * 100)) + data
    return b"".join(lines)


def cut_at_word(data: bytes, rng: Generator) -> bytes:
    """End a text file before, in or after a word."""
    start, end = pick(rng, words(data))
    return data[: int(pick(rng, (start, end, (start + end) // 2)))]


def damage_text(path: Path, rng: Generator) -> str:
    """Damage a text file in one of the ways; return which."""
    way = pick(rng, (*[change_words] * 3, change_lines, cut_at_word, change_bytes))
    path.write_bytes(way(path.read_bytes(), rng))
    return str(way.__name__)


def misplace(path: Path, rng: Generator) -> str:
    """Put something that is no ordinary file in the place of one; return what."""
    data = path.read_bytes()
    path.unlink()
    links = ("dangling link", "link loop", "endless device", "link")
    kind = str(pick(rng, ("nothing", "empty file", "folder", "fifo", *links)))
    match kind:
        case "empty file":
            path.write_bytes(b"")
        case "folder":
            path.mkdir()
        case "fifo":
            os.mkfifo(path)
        case "dangling link":
            path.symlink_to(path.with_name("nowhere"))
        case "link loop":
            path.symlink_to(path)
        case "endless device":
            path.symlink_to("/dev/zero")
        case "link":
            target = path.with_name(f"{path.name}.real")
            target.write_bytes(data)
            path.symlink_to(target)
    return kind
