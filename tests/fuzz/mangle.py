"""Mutations of a valid command line and of the files that it reads."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence
from pathlib import Path

NUMBERS = (
    "0", "-0", "1", "-1", "2", "3.5", "1e-300", "5e-324", "1e-9", "1e9", "1e18", "1e80", "1e155", "1e300", "-1e300",
    "2e300", "1e308", "nan", "inf", "-inf",
    "9" * 400, "9" * 4400,
    "", "x", "1e", "0x10", "1_000", "٣", "true", "None", "1;2", "1 2", "é", "\x1b[31m", "--", "..", "/",
)  # fmt: skip
DUMMIES = ("-99999", "99999", "*", "0", "1e32", "65535", "1e12", "-1e9", "NaN", "null", "inf")
_BINARY = (
    b"\x89PNG\r\n\x1a\n",
    b"PK\x03\x04",
    b"\x1f\x8b\x08",
    b"MATLAB 5.0 MAT-file",
    b"\x89HDF\r\n\x1a\n",
    b"CDF\x01",
    b"PAR1",
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")


def mangled_file(data: bytes, rng: random.Random) -> bytes:
    """A file's bytes after one to three mutations."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(_OF_BYTES)(data, rng)
    return data


def mangled_arguments(arguments: Sequence[str], options: Sequence[str], rng: random.Random) -> list[str]:
    """A command's arguments after one or two mutations; the command's name stays."""
    mangled = list(arguments)
    for _ in range(rng.choice((1, 1, 2))):
        rng.choice(_OF_ARGUMENTS if mangled else (_add_option,))(mangled, options, rng)
    return mangled


def _numbers(data: bytes, rng: random.Random) -> bytes:
    """Some numbers are others."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    chosen = rng.sample(found, min(len(found), rng.choice((1, 1, 1, 2, 5, len(found)))))
    values, several = rng.choices(NUMBERS, k=3), rng.random() < 0.5
    for match in sorted(chosen, key=lambda one: -one.start()):
        value = (rng.choice(values) if several else values[0]).encode()
        data = data[: match.start()] + value + data[match.end() :]
    return data


def _scaled(data: bytes, rng: random.Random) -> bytes:
    """One number with another exponent or sign."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    match = rng.choice(found)
    try:
        value = float(match[0]) * rng.choice((-1.0, 1e-30, 1e-9, 1e-3, 1e3, 1e6, 1e9, 1e30, 1e150))
    except OverflowError:
        return data
    return data[: match.start()] + repr(value).encode() + data[match.end() :]


def _exponents(data: bytes, rng: random.Random) -> bytes:
    """Several numbers, each with another power of ten."""
    share = rng.choice((0.02, 0.1, 0.5))

    def other(match: re.Match[bytes]) -> bytes:
        return match[0] if rng.random() > share else match[0] + b"e%d" % rng.randint(-40, 40)

    return re.sub(rb"(?<![\w.])\d+\.?\d*(?![\w.])", other, data)


def _words(data: bytes, rng: random.Random) -> bytes:
    """One word is another one of the file."""
    found = list(_WORD.finditer(data))
    if not found:
        return data
    match, other = rng.choice(found), rng.choice(found)
    return data[: match.start()] + other[0] + data[match.end() :]


def _of_lines(change: Callable[[list[bytes], random.Random], object]) -> Callable[[bytes, random.Random], bytes]:
    def mutation(data: bytes, rng: random.Random) -> bytes:
        lines = data.split(b"\n")
        change(lines, rng)
        return b"\n".join(lines)

    return mutation


def _delete_line(lines: list[bytes], rng: random.Random) -> None:
    del lines[rng.randrange(len(lines))]


def _repeat_line(lines: list[bytes], rng: random.Random) -> None:
    lines.insert(rng.randrange(len(lines)), rng.choice(lines))


def _delete_lines(lines: list[bytes], rng: random.Random) -> None:
    start = rng.randrange(len(lines))
    del lines[start : start + rng.randrange(1, len(lines) + 1)]


def _shuffle(lines: list[bytes], rng: random.Random) -> None:
    rest = lines[1:]
    rng.shuffle(rest)
    lines[1:] = rest


def _column(lines: list[bytes], rng: random.Random) -> None:
    """One column goes, or stands twice."""
    column, again = rng.randrange(lines[0].count(b",") + 1), rng.random() < 0.5
    for i, line in enumerate(lines):
        cells = line.split(b",")
        if column < len(cells):
            cells[column : column + 1] = [cells[column]] * 2 if again else []
            lines[i] = b",".join(cells)


def _cells(lines: list[bytes], rng: random.Random) -> None:
    """A whole column has one value."""
    column, value = rng.randrange(lines[0].count(b",") + 1), rng.choice(NUMBERS).encode()
    for i, line in enumerate(lines[1:], 1):
        cells = line.split(b",")
        if column < len(cells) and line:
            cells[column] = value
            lines[i] = b",".join(cells)


def _scattered(lines: list[bytes], rng: random.Random) -> None:
    """In every row other cells are missing, or have what a logger writes in place of a reading."""
    share = rng.choice((0.02, 0.1, 0.3, 0.6))
    values = rng.choice(((b"",), (b"",), (rng.choice(DUMMIES).encode(),), tuple(map(str.encode, DUMMIES))))
    for i, line in enumerate(lines[1:], 1):
        time, *cells = line.split(b",")
        lines[i] = b",".join([time, *(rng.choice(values) if rng.random() < share else cell for cell in cells)])


def _run_of_dummies(lines: list[bytes], rng: random.Random) -> None:
    """Successive rows have the same dummy in some columns, or in all of them."""
    first, value, all_of_them = rng.randrange(len(lines)), rng.choice(DUMMIES).encode(), rng.random() < 0.5
    chosen = {i for i in range(1, lines[0].count(b",") + 1) if all_of_them or rng.random() < 0.3}
    for at in range(max(first, 1), min(first + rng.choice((1, 2, 3, 25)), len(lines))):
        lines[at] = b",".join(value if i in chosen else cell for i, cell in enumerate(lines[at].split(b",")))


def _other_numbers(lines: list[bytes], rng: random.Random) -> None:
    """A column in another unit, or shifted, from some row on: the time's too."""
    column, first = (
        rng.choice((0, 0, rng.randrange(lines[0].count(b",") + 1))),
        rng.choice((1, rng.randrange(len(lines)))),
    )
    factor = rng.choice((1.0, 1.0, -1.0, 1e-9, 1e-3, 1e3, 1e6, 1e9, 57.29578, 0.01745))
    offset = rng.choice((0.0, 1.0, -1e3, 1e7, 1.7e9, 1e12, 1e14, 1e15, -1e15, 1e18))
    for i, line in enumerate(lines[max(first, 1) :], max(first, 1)):
        cells = line.split(b",")
        if column < len(cells) and _NUMBER.fullmatch(cells[column]):
            cells[column] = repr(factor * float(cells[column]) + offset).encode()
            lines[i] = b",".join(cells)


def _separator(data: bytes, rng: random.Random) -> bytes:
    """Another separator, which a declaration may name too."""
    named = {b"comma": b",", b"semicolon": b";", b"tab": b"\t", b"space": b" "}
    called = rng.choice(tuple(named))
    if b"[columns]" in data:
        return data.replace(b'separator = "semicolon"', b'separator = "%s"' % called)
    if b"[[sensor]]" in data:
        return data + b'\n[columns]\nseparator = "%s"\n' % called
    return data.replace(rng.choice((b",", b";")), rng.choice((*named.values(), b"|", b", ", b" ,")))


def _nested(data: bytes, rng: random.Random) -> bytes:
    """Lists in lists in place of a number."""
    found = list(_NUMBER.finditer(data))
    depth = rng.choice((1, 2, 50, 3000))
    match = rng.choice(found) if found else None
    start, stop, inner = (match.start(), match.end(), match[0]) if match else (0, 0, b"")
    return data[:start] + b"[" * depth + inner + b"]" * depth + data[stop:]


def _binary(data: bytes, rng: random.Random) -> bytes:
    """Another kind of file under this name."""
    return rng.choice(_BINARY) + rng.choice((b"", rng.randbytes(100), data))


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes that belong to no text."""
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 2, 8))) + data[at + rng.choice((0, 1, 4)) :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _dressed(data: bytes, rng: random.Random) -> bytes:
    """Line ends, byte-order mark, and characters that no editor shows."""
    return rng.choice(
        (
            data.replace(b"\n", b"\r\n"),
            data.replace(b"\n", b"\r"),
            b"\xef\xbb\xbf" + data,
            data.decode("utf-8", "replace").encode("utf-16"),
            data.replace(b",", b";"),
            data.replace(b".", b","),
            data + b"\0",
            data + data,
            data.rstrip(b"\n"),
            b"\n\n" + data,
            b"",
        )
    )


_OF_BYTES = (
    _numbers, _numbers, _numbers, _scaled, _scaled, _exponents, _words, _bytes, _cut, _dressed,
    _separator, _nested, _binary,
    *map(_of_lines, (_delete_line, _repeat_line, _delete_lines, _shuffle, _column, _cells, _cells)),
    *map(_of_lines, (_scattered, _scattered, _scattered, _run_of_dummies, _other_numbers, _other_numbers)),
)  # fmt: skip


def _change_value(arguments: list[str], options: Sequence[str], rng: random.Random) -> None:
    at = rng.randrange(len(arguments))
    arguments[at] = rng.choice((*NUMBERS, *options, *arguments))


def _drop(arguments: list[str], options: Sequence[str], rng: random.Random) -> None:
    del arguments[rng.randrange(len(arguments))]


def _repeat(arguments: list[str], options: Sequence[str], rng: random.Random) -> None:
    arguments.insert(rng.randrange(len(arguments) + 1), rng.choice(arguments))


def _add_option(arguments: list[str], options: Sequence[str], rng: random.Random) -> None:
    arguments += [rng.choice(options), *rng.choices((*NUMBERS, *arguments), k=rng.choice((0, 1, 1, 1, 3)))]


_OF_ARGUMENTS = (_change_value, _drop, _repeat, _add_option, _add_option)


def mangle_names(folder: Path, rng: random.Random) -> None:
    """One file is a folder, a link to itself, gone, or a device that does not end."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    file = rng.choice(files)
    file.unlink()
    kind = rng.choice(("gone", "folder", "loop", "/dev/zero", "/dev/urandom", "/dev/null"))
    if kind == "folder":
        file.mkdir()
    elif kind != "gone":
        file.symlink_to(file.name if kind == "loop" else kind)
