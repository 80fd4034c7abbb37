"""Ways to damage one file: its bytes, its fields, its words, its place in the file system."""

import json
import os
import re
import struct

from tests.abuse.layouts import binary_fields, cut_records

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
    *(b"--help", b" ", b".", b"\x1b[31mred\x1b[2J.jpg", b"\r\n\r\n", b"%s%n%d{0}{name}.jpg"),
    *(b"[bold]x[/bold].jpg", b"n" * 10_000, b"'; DROP TABLE images", "\u2028.jpg".encode()),
    *("\u202egpj.exe".encode(), "é".encode(), "e\u0301".encode(), "\U0001f4f7.jpg".encode()),
)
BROKEN_NAMES = (b"\xff\xfe.jpg", b"\xed\xb2\x80.jpg", b"\xc0\xaf.jpg", b"caf\xe9.jpg", b"\xf5\x80\x80\x80")
"""No UTF-8: a stray byte, a surrogate, an overlong slash, Latin-1, beyond the last code point."""


def pick(rng, items):
    """Return one of the items as it is; numpy's `choice` would make an array of them."""
    return items[int(rng.integers(len(items)))]


def damage_binary(path, rng):
    """Damage a binary file of a model in one of the ways; return which."""
    way = pick(rng, (*[change_fields] * 3, shuffle_fields, shuffle_fields, change_bytes, change_bytes))
    data = path.read_bytes()
    path.write_bytes(way(data, rng, binary_fields(path.stem, data)))
    return way.__name__


def damage_text(path, rng, *further):
    """Damage a text file in one of the ways; return which."""
    way = pick(rng, (*[change_words] * 3, change_lines, change_bytes, *further))
    path.write_bytes(way(path.read_bytes(), rng))
    return way.__name__


def draw_records(path, rng):
    """Remove, repeat or exchange records of a binary file, and put their count right."""
    records = cut_records(path.stem, path.read_bytes())
    count = int(rng.integers(2 * len(records) + 1))
    permuted = rng.random() < 0.5
    order = rng.permutation(len(records))[:count] if permuted else rng.integers(len(records), size=count)
    path.write_bytes(struct.pack("<Q", len(order)) + b"".join(records[k] for k in order.tolist()))
    return f"{len(order)} of {len(records)}"


def change_bytes(data, rng, _fields=()):
    """Flip, insert, remove, repeat or blank a few bytes anywhere."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        at, length = int(rng.integers(len(changed) + 1)), int(rng.integers(1, 17))
        some = slice(at, at + length)
        match int(rng.integers(6)):
            case 0 if at < len(changed):
                changed[at] ^= int(rng.integers(1, 256))
            case 1:
                changed[at:at] = rng.bytes(length)
            case 2:
                del changed[some]
            case 3:
                changed[at:at] = changed[some]
            case kind:
                changed[some] = (b"\xff" if kind == 4 else b"\0") * len(changed[some])
    return bytes(changed)


def change_fields(data, rng, fields):
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


def _value(field, rng):
    if field.kind == "name":
        return pick(rng, (*HOSTILE_NAMES, *BROKEN_NAMES, b"")) + b"\0"
    if field.kind == "d":
        return struct.pack("<d", pick(rng, DOUBLES))
    return (pick(rng, INTEGERS) % 256**field.size).to_bytes(field.size, "little")


def shuffle_fields(data, rng, fields):
    """Remove a field, write it twice or over another, or end the file about it; lengths may no longer fit."""
    first, second = pick(rng, fields), pick(rng, fields)
    start, end = first.offset, first.offset + first.size
    size = min(first.size, second.size)
    shuffled = (
        data[:start] + data[end:],
        data[:end] + data[start:],
        data[: second.offset] + data[start : start + size] + data[second.offset + size :],
        data[: max(start + int(rng.integers(-1, 2)), 0)],
    )
    return pick(rng, shuffled)


def change_words(data, rng):
    """Replace, remove, repeat or exchange a few words of a text file, or end it in the middle of one."""
    for _ in range(int(rng.integers(1, 4))):
        spans = [match.span() for match in re.finditer(rb"\S+", data)]
        if not spans:
            return data
        start, end = pick(rng, spans)
        if rng.random() < 0.15:
            return data[: pick(rng, (start, end, (start + end) // 2))]
        own, other = data[start:end], data[slice(*pick(rng, spans))]
        hostile = pick(rng, WORDS).encode()
        data = data[:start] + pick(rng, (*[hostile] * 3, b"", own + b" " + own, other)) + data[end:]
    return data


def change_lines(data, rng):
    """Remove, repeat, exchange or cut lines, or change what begins the file or ends its lines."""
    lines = data.splitlines(keepends=True)
    at, other = int(rng.integers(len(lines))), int(rng.integers(len(lines)))
    begin = pick(rng, (b"\xef\xbb\xbf", b"\xff\xfe", b"\0" * 100))
    end = pick(rng, (b"\r\n", b"\r", b"\0", b"\n\n", b" ", b"\x85"))
    odd = pick(rng, (b"\n", b"#\n", b" \t\n", b"\xff\xfe\n", b"1 " * 20_000 + b"\n"))
    exchanged = [*lines]
    exchanged[at], exchanged[other] = lines[other], lines[at]
    changed = (
        lines[:at] + lines[at + 1 :],
        lines[: at + 1] + lines[at:],
        exchanged,
        lines[:at],
        [data.replace(b"\n", end)],
        [*lines[:at], odd, *lines[at + 1 :]],
        [begin, data],
    )
    return b"".join(pick(rng, changed))


def change_values(data, rng):
    """Replace, remove or repeat one to three values somewhere in a JSON file."""
    content = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        holder, key = _random_place(content, rng)
        if rng.random() < 0.25:
            del holder[key]
        else:
            odd = (None, True, [], {}, [[]], *INTEGERS, *DOUBLES, *WORDS)
            holder[key] = pick(rng, (*odd, [holder[key]] * 2))
        if not content:
            break
    return json.dumps(content).encode("utf-8", errors="surrogatepass")


def _random_place(holder, rng):
    """Return a container inside a JSON value and one of its keys or indices, found by a walk down."""
    while True:
        key = pick(rng, [*holder] if isinstance(holder, dict) else range(len(holder)))
        below = holder[key]
        if not isinstance(below, dict | list) or not below or rng.random() < 0.15:
            return holder, key
        holder = below


def misplace(path, rng):
    """Put something that is no ordinary file in the place of one; return what."""
    data = path.read_bytes()
    path.unlink()
    links = {"dangling link": "nowhere", "link loop": path.name, "link": f"{path.name}.real"}
    kind = pick(rng, ("nothing", "empty file", "folder", "fifo", *links, "endless device"))
    if kind == "empty file":
        path.touch()
    elif kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "endless device":
        path.symlink_to("/dev/zero")
    elif kind in links:
        path.symlink_to(links[kind])
    if kind == "link":
        path.with_name(links[kind]).write_bytes(data)
    return kind
