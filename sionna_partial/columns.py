"""Tables of numbers and texts in CSV files, as spreadsheets and programs write them."""

import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sionna_partial.errors import SionnaPartialError
from sionna_partial.files import read_bytes

MAX_CSV_BYTES = 100_000_000

HEADER_LINES = 50
"""Number of lines in which the header is looked for."""

_SEPARATORS = ",;\t"

_COMMENT = "#"

_MEANT = "separate columns by commas and write decimal points, or separate them by semicolons"


class Columns(NamedTuple):
    """Columns by name: numbers and texts, their headers, the line of each row, and headers without a name."""

    numbers: dict[str, list[float]]
    texts: dict[str, list[str]]
    headers: dict[str, str]
    lines: list[int]
    others: list[str]


def read_columns(
    path: str | os.PathLike[str],
    field: str,
    error: type[SionnaPartialError],
    names: Mapping[str, str],
    remedy: str,
    texts: Sequence[str] = (),
) -> Columns:
    """Read a CSV, or raise an `error`; `names` maps headers in lower case to names, `texts` are names of texts.

    Lines before the header and comments (#) are skipped. Commas, semicolons or tabs separate columns; with the latter
    two, numbers may have decimal commas.
    """
    given = f"{field} = '{Path(path).name}'"
    content = read_bytes(path, field, error, MAX_CSV_BYTES, "leave lines out.")
    try:
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(f"{given} cannot be read ({cause}): {remedy}") from cause
    if text and text[-1] not in "\r\n":
        last = text.splitlines()[-1][-40:]
        raise error(
            f"{given} ends in {last!r}, without a line end: the file may be cut. Copy it again, or add a line end."
        )
    lines = io.StringIO(text, newline="").readlines()
    first, separator = _header_of(lines[:HEADER_LINES], names)
    rows = csv.reader(lines[first:], delimiter=separator, skipinitialspace=True)
    numbered = ((first + rows.line_num, [cell.strip() for cell in row]) for row in rows)
    try:
        return _columns(given, numbered, error, names, texts, decimal_comma=separator != ",")
    except csv.Error as cause:
        raise error(f"{given}, line {first + rows.line_num} cannot be read ({cause}): {remedy}") from cause


def _header_of(lines: Sequence[str], names: Mapping[str, str]) -> tuple[int, str]:
    """Return the index of the line with most known headers, and its separator; else the first line with columns."""
    ways = [(number, separator) for number in range(len(lines)) for separator in _SEPARATORS]
    if not ways:
        return 0, ","

    def known(way: tuple[int, str]) -> int:
        cells = lines[way[0]].strip(f"{_COMMENT} \r\n").split(way[1])
        return len({names.get(cell.strip(' "').lower()) for cell in cells} - {None})

    best = max(ways, key=known)
    if known(best):
        return best
    first = next((number for number, line in enumerate(lines) if not line.startswith(_COMMENT)), 0)
    return first, max(_SEPARATORS, key=lines[first].count)


def _columns(
    given: str,
    rows: Iterator[tuple[int, list[str]]],
    error: type[SionnaPartialError],
    names: Mapping[str, str],
    texts: Sequence[str],
    *,
    decimal_comma: bool,
) -> Columns:
    _, header = next(rows, (0, [""]))
    header = [header[0].lstrip(f"{_COMMENT} "), *header[1:]] if header else [""]
    known = [(at, names[name.lower()]) for at, name in enumerate(header) if name.lower() in names]
    for name in dict.fromkeys(name for _, name in known if name not in texts):
        same = [header[at] for at, other in known if other == name]
        if len(same) > 1:
            raise error(f"{given} has {len(same)} columns of {name} ({', '.join(same)}): keep one of them, or name it.")
    columns = {name: at for at, name in reversed(known)}
    others = [name for name in header if name.lower() not in names]
    found = Columns({}, {}, {name: header[at] for name, at in columns.items()}, [], others)
    found.texts.update({name: [] for name in columns if name in texts})
    found.numbers.update({name: [] for name in columns if name not in texts})
    for line, row in rows:
        if not any(row) or row[0].startswith(_COMMENT):
            continue
        if len(row) > len(header):
            what = f"has {len(row)} cells for {len(header)} columns"
            raise error(f"{given}, line {line} {what}: {_MEANT}.")
        found.lines.append(line)
        for name, at in columns.items():
            text = row[at] if at < len(row) else ""
            if name in texts:
                found.texts[name].append(text)
                continue
            try:
                found.numbers[name].append(float(text.replace(",", ".") if decimal_comma else text))
            except ValueError as cause:
                meant = f"{_MEANT}." if "," in text else "correct the line, or leave it out."
                what = f"{header[at]} = {text[:80]!r} is not a number"
                raise error(f"{given}, line {line}: {what}: {meant}") from cause
    if columns and not found.lines:
        raise error(f"{given} has a header and no rows: check that it was written completely.")
    return found
