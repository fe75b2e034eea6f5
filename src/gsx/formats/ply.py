"""PLY files: tables of scalars by element, such as vertices of splats and of point clouds (3D-GS, save_ply).

Reads ascii and both binary byte orders, writes binary little-endian. Skips other elements, also with lists, such as
faces. Colours have the names and units that programs use. Damaged content raises InputError, which calls the file "it".
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsx.core.errors import InputError
from gsx.core.files import refuse_lfs_pointer, replace_file

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
"""numpy's names of PLY's types by their old and new names; files are written with the old ones."""
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
"""numpy's byte order of each format."""
VERTICES = "vertex"
"""The element of points and splats."""

HEADER_END = b"\nend_header"
"""Last line of a header."""
MOST_DIGITS = 15
"""Most digits of a number of rows."""
COLOUR_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("R", "G", "B"),
)
"""Names of the three channels, the usual ones first (diffuse_: MeshLab and older scanners)."""
OVERSHOOT = 0.5
"""Floats in [0, 1] may exceed it by this, because colours of harmonics are not clipped."""


@dataclass(frozen=True, kw_only=True)
class Element:
    """One element of a header."""

    name: str
    count: int
    properties: tuple[tuple[str, str, str], ...]
    """(name, numpy's type of values, type of a list's length or '' for a scalar), in order."""

    @property
    def scalar(self) -> bool:
        """Return whether no property is a list, so that all rows have one size."""
        return not any(length for _, _, length in self.properties)

    def row(self, order: str, lengths: Sequence[int] = ()) -> np.dtype:
        """Returns the type of a row with lists of these lengths."""
        rest, fields = iter(lengths), []
        for number, (name, kind, length) in enumerate(self.properties):
            if length:
                fields += [(f"{number} length", order + length), (f"{number} items", order + kind, (next(rest),))]
            else:
                fields.append((name, order + kind))
        return np.dtype(fields)


@dataclass(frozen=True, kw_only=True)
class Header:
    """The header of a PLY."""

    size: int
    """Bytes before the body."""
    layout: str
    """A key of ORDERS."""
    elements: tuple[Element, ...]


# -- reading -----------------------------------------------------------------------------------------------------------


def read_ply(path: str | Path) -> dict[str, np.ndarray]:
    """Returns the vertex properties as stored, arrays [vertices] by name.

    Raises:
        InputError: the file is missing, damaged, or has no vertices of scalars.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"Point file '{path}' does not exist, check the path.")
    refuse_lfs_pointer(path)
    try:
        return vertices_of(path.read_bytes())
    except (OSError, InputError) as problem:
        raise InputError(f"'{path}' cannot be read: {getattr(problem, 'strerror', None) or problem}") from None


def vertices_of(content: bytes) -> dict[str, np.ndarray]:
    """Returns the vertex properties of a file's content in native byte order; errors as `read_ply`."""
    header = header_in(content)
    position = next((i for i, element in enumerate(header.elements) if element.name == VERTICES), -1)
    if position < 0:
        names = ", ".join(element.name for element in header.elements) or "none"
        raise InputError(f"it has no vertices, its elements are: {names}; save it as a plain point cloud")
    element = header.elements[position]
    if not element.scalar:
        name = next(name for name, _, length in element.properties if length)
        raise InputError(f"it has lists in vertex property '{name}', only scalar ones can be read: save it without")
    rows = table_at(content, header, position)
    return {name: np.ascontiguousarray(rows[name].astype(rows[name].dtype.newbyteorder("=")))
            for name, _, _ in element.properties}  # fmt: skip


def elements_of(content: bytes) -> dict[str, np.ndarray]:
    """Returns all elements of scalars as structured arrays, by name."""
    header = header_in(content)
    return {one.name: table_at(content, header, i) for i, one in enumerate(header.elements) if one.scalar}


def table_at(content: bytes, header: Header, position: int) -> np.ndarray:
    """Returns the rows of the element at a position, which must have no lists."""
    element = header.elements[position]
    if header.layout == "ascii":
        return _ascii(content[header.size :], header.elements[:position], element)
    start, order = header.size, ORDERS[header.layout]
    for other in header.elements[:position]:
        start += _size(content, start, other, order)
    table = element.row(order)
    if len(content) - start < element.count * table.itemsize:
        present = max(0, len(content) - start) // table.itemsize
        raise InputError(f"it ends after {present} of {element.count} rows of '{element.name}': copy or export it anew")
    return np.frombuffer(content, table, element.count, start)


def header_in(content: bytes) -> Header:
    """Returns the header of a file, with or without body; InputError: it has none, or an invalid one."""
    size = header_length(content)
    if not content.startswith(b"ply") or not size:
        raise InputError("it has no complete PLY header: export it anew as PLY")
    lines = [line.split() for line in content[:size].decode("latin-1").splitlines()]
    layout = next((words[1] for words in lines if len(words) > 1 and words[0] == "format"), "missing")
    if layout not in ORDERS:
        raise InputError(f"it has format {layout}: save it as binary_little_endian")
    return Header(size=size, layout=layout, elements=tuple(_elements(lines)))


def header_length(content: bytes) -> int:
    """Returns the bytes of a PLY's header; 0: it has no end. A comment may contain the word that ends it."""
    end = content.find(HEADER_END)
    return content.find(b"\n", end + 1) + 1 if end >= 0 else 0


def length_of(head: bytes) -> int:
    """Returns the bytes of a binary file by its header."""
    header = header_in(head)
    if header.layout == "ascii" or not all(element.scalar for element in header.elements):
        raise InputError("it has no header of a binary PLY of scalars: export it anew")
    return header.size + sum(element.count * element.row("<").itemsize for element in header.elements)


def _elements(lines: list[list[str]]) -> Iterable[Element]:
    """Yields the elements of a header."""
    starts = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    names = set()
    for start, stop in pairwise([*starts, len(lines)]):
        words = lines[start]
        if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > MOST_DIGITS:
            raise InputError(f"it has '{' '.join(words)[:80]}', which names no element with its number: export it anew")
        if words[1] in names:
            raise InputError(f"it has two elements '{words[1]}': export it anew")
        names.add(words[1])
        rows = [line for line in lines[start:stop] if line[:1] == ["property"]]
        properties = tuple(_property(line, words[1]) for line in rows)
        if len({name for name, _, _ in properties}) < len(properties) or not properties:
            raise InputError(f"it names no property of element '{words[1]}', or one twice: export it anew")
        yield Element(name=words[1], count=int(words[2]), properties=properties)


def _property(words: list[str], element: str) -> tuple[str, str, str]:
    """Returns (name, type, type of a list's length) by a line of a header."""
    if len(words) == 3 and words[1] in TYPES:
        return words[2], TYPES[words[1]], ""
    if len(words) == 5 and words[1] == "list" and {words[2], words[3]} <= TYPES.keys() and TYPES[words[2]][0] != "f":
        return words[4], TYPES[words[3]], TYPES[words[2]]
    raise InputError(f"it has '{' '.join(words)[:80]}' in element '{element}', which is no property: export it anew")


def _size(content: bytes, start: int, element: Element, order: str) -> int:
    """Returns the bytes of an element of a binary file."""
    if element.scalar:
        return element.count * element.row(order).itemsize
    if not element.count:
        return 0
    equal = element.row(order, _row_end(content, start, element, order)[1])
    size = element.count * equal.itemsize
    if len(content) - start >= size:  # faces often have equally many corners
        rows = np.frombuffer(content, equal, element.count, start)
        lengths = [rows[name] for name in equal.names or () if name.endswith(" length")]
        if all((values == values[0]).all() for values in lengths):
            return size
    end = start
    for _ in range(element.count):
        end, _ = _row_end(content, end, element, order)
    return end - start


def _row_end(content: bytes, start: int, element: Element, order: str) -> tuple[int, list[int]]:
    """Returns (byte at which the row at `start` ends, lengths of its lists)."""
    lengths: list[int] = []
    for _, kind, length in element.properties:
        if length and start + np.dtype(length).itemsize <= len(content):
            lengths.append(int(np.frombuffer(content, order + length, 1, start)[0]))
        start += np.dtype(kind).itemsize * (lengths[-1] if length and lengths else 1)
        start += np.dtype(length).itemsize if length else 0
        if start > len(content) or min(lengths, default=0) < 0:
            raise InputError(f"it ends within its element '{element.name}': copy or export it anew")
    return start, lengths


def _ascii(body: bytes, before: Sequence[Element], element: Element) -> np.ndarray:
    """Returns the rows of an element of a text file, a line each, after those of the elements `before`."""
    first = sum(other.count for other in before)
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()][first : first + element.count]
    table = element.row("<")
    if len(lines) < element.count:
        raise InputError(
            f"it ends after {len(lines)} of {element.count} rows of '{element.name}': copy or export it anew"
        )
    try:
        return np.loadtxt(lines, table, ndmin=1, comments=None) if lines else np.empty(0, table)
    except (ValueError, OverflowError) as problem:
        raise InputError(f"it has an unreadable row of '{element.name}' ({problem}): export it anew") from None


# -- writing -----------------------------------------------------------------------------------------------------------


def write_ply(path: str | Path, columns: Mapping[str, np.ndarray], comments: Iterable[str] = ()) -> None:
    """Writes arrays [vertices] as vertex properties, atomically.

    Raises:
        InputError: the file cannot be written.
        ValueError: the arrays differ in length.
    """
    names = {code: name for name, code in reversed(TYPES.items())}
    codes = {name: column.dtype.str[1:] for name, column in columns.items()}
    rows = np.rec.fromarrays(list(columns.values()), np.dtype([(name, f"<{code}") for name, code in codes.items()]))
    header = header_of({VERTICES: (len(rows), {name: names[code] for name, code in codes.items()})}, comments)
    write_whole(Path(path), header + rows.tobytes())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file of points or splats atomically; InputError: it cannot be written."""
    try:
        replace_file(path, content)
    except OSError as problem:
        raise InputError(f"'{path}' cannot be written ({problem.strerror}), check the folder and its space.") from None


def header_of(elements: Mapping[str, tuple[int, Mapping[str, str]]], comments: Iterable[str] = ()) -> bytes:
    """Returns the header of a binary file; elements: (rows, PLY's types of its properties) of each."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {plain(comment)}" for comment in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {kind} {inner}" for inner, kind in properties.items())]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def plain(comment: str) -> str:
    """Returns a comment as one line of ASCII; other characters become escapes."""
    return " ".join(comment.split()).encode("ascii", "backslashreplace").decode()


def colours_among(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Returns the colour columns [N, 3] as stored; None: there are none."""
    for names in COLOUR_NAMES:
        if set(names) <= columns.keys():
            return np.stack([columns[name] for name in names], axis=1)
    return None


def full_scale_of(values: np.ndarray) -> float | None:
    """Returns the value of full intensity by type and range; None: unknown unit.

    Bytes have 255, other integers 255 or 65,535, floats 1 within OVERSHOOT of [0, 1], else 255.
    """
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if values.dtype == np.uint8 or not finite.size:
        return 255.0 if values.dtype.kind in "iu" else 1.0
    least, most = float(finite.min()), float(finite.max())
    if values.dtype.kind == "f":
        if least >= -OVERSHOOT and most <= 1 + OVERSHOOT:
            return 1.0
        return 255.0 if least >= 0 and most <= 255 else None
    return next((full for full in (255.0, 65535.0) if least >= 0 and most <= full), None)
