"""PLY files with one table of scalars per vertex: splats and point clouds (3D-GS, save_ply).

Reads binary little-endian and ascii, writes binary little-endian. Elements after the vertices are ignored.
"""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsx.core.errors import InputError
from gsx.core.files import replace_file

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
"""numpy's names of PLY's types, under both generations of names; the first name of each is written."""


HEADER_END = b"\nend_header"
"""Of a PLY, at the beginning of a line."""
MOST_DIGITS = 15
"""Of a number of vertices: a file with more does not exist."""


def read_ply(path: str | Path) -> dict[str, np.ndarray]:
    """The vertex properties by name, each an array [vertices] of the type stored.

    Raises:
        InputError: the file is missing, is no PLY of the kinds above, or ends early.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"Point file '{path}' does not exist, check the path.")
    data = path.read_bytes()
    body = header_length(data)
    if not data.startswith(b"ply") or not body:
        raise InputError(f"'{path}' has no complete PLY header, export it anew as PLY.")
    lines = [line.split() for line in data[:body].decode("latin-1").splitlines()]
    layout, count, table = _layout(lines, path)
    rows = _ascii(data[body:], count, table, path) if layout == "ascii" else _binary(data, body, count, table, path)
    return {name: np.ascontiguousarray(rows[name]) for name in table.names or ()}


def write_ply(path: str | Path, columns: Mapping[str, np.ndarray], comments: Iterable[str] = ()) -> None:
    """Writes arrays [vertices] of equal length as vertex properties; the file appears whole or not at all.

    Raises:
        InputError: the file cannot be written.
        ValueError: the arrays differ in length, have more than one dimension, or a type that PLY lacks.
    """
    path = Path(path)
    counts = {column.shape for column in columns.values()}
    if len(counts) != 1 or len(next(iter(counts))) != 1:
        raise ValueError(f"PLY columns need one dimension and one length, got shapes {sorted(counts)}")
    names = {code: name for name, code in reversed(TYPES.items())}
    codes = {name: column.dtype.str[1:] for name, column in columns.items()}
    if not set(codes.values()) <= set(names):
        raise ValueError(f"PLY knows the types {', '.join(names)}, got {codes}")
    rows = np.empty(next(iter(counts)), np.dtype([(name, f"<{code}") for name, code in codes.items()]))
    for name, column in columns.items():
        rows[name] = column
    header = header_of({"vertex": (len(rows), {name: names[code] for name, code in codes.items()})}, comments)
    write_whole(path, header + rows.tobytes())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file of points or splats; it appears whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    try:
        replace_file(path, content)
    except OSError as problem:
        raise InputError(f"'{path}' cannot be written ({problem.strerror}), check the folder and its space.") from None


def header_of(elements: Mapping[str, tuple[int, Mapping[str, str]]], comments: Iterable[str] = ()) -> bytes:
    """The header of a binary file; elements: how many there are of each name, and their properties with PLY's types."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {plain(comment)}" for comment in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {kind} {inner}" for inner, kind in properties.items())]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def elements_of(content: bytes) -> dict[str, np.ndarray]:
    """All elements of a binary file by name, as structured arrays.

    Raises:
        InputError: it is no binary PLY of scalar properties, or ends early.
    """
    body, lines = _binary_header(content)
    found: dict[str, np.ndarray] = {}
    for name, count, kinds in _elements(lines):
        if len(content) - body < count * kinds.itemsize:
            raise InputError(f"it ends within its element '{name}': copy or export it anew")
        found[name] = np.frombuffer(content, kinds, count, body)
        body += count * kinds.itemsize
    return found


def length_of(head: bytes) -> int:
    """Bytes of the binary file that begins so, by its header.

    Raises:
        InputError: it has no complete header of a binary PLY of scalar properties.
    """
    body, lines = _binary_header(head)
    return body + sum(count * kinds.itemsize for _, count, kinds in _elements(lines))


def header_length(content: bytes) -> int:
    """Bytes of a PLY's header; 0 where it has no end. A comment may hold the word that ends it."""
    end = content.find(HEADER_END)
    return content.find(b"\n", end + 1) + 1 if end >= 0 else 0


def _binary_header(content: bytes) -> tuple[int, list[list[str]]]:
    """Length of the header, and the words of its lines."""
    body = header_length(content)
    lines = [line.split() for line in content[:body].decode("latin-1").splitlines()]
    whole = content.startswith(b"ply") and ["end_header"] in lines
    if not whole or ["format", "binary_little_endian", "1.0"] not in lines:
        raise InputError("it has no complete header of a binary PLY: export it anew")
    return body, lines


def _elements(lines: list[list[str]]) -> list[tuple[str, int, np.dtype]]:
    """Name, number and type of the elements that a header tells."""
    starts = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    found = []
    for start, stop in pairwise([*starts, len(lines)]):
        words = lines[start]
        properties = [line for line in lines[start:stop] if line[:1] == ["property"]]
        if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > MOST_DIGITS:
            raise InputError(f"'{' '.join(words)}' names no element with its number: export it anew")
        if not properties or any(len(one) != 3 or one[1] not in TYPES for one in properties):
            raise InputError(f"its element '{words[1]}' has not only scalar properties: export it anew")
        if len({name for _, _, name in properties}) < len(properties):
            raise InputError(f"its element '{words[1]}' names a property twice: export it anew")
        kinds = np.dtype([(name, f"<{TYPES[kind]}") for _, kind, name in properties])
        found.append((words[1], int(words[2]), kinds))
    return found


def plain(comment: str) -> str:
    """In one line of ASCII, all that headers may hold; other characters become escapes."""
    return " ".join(comment.split()).encode("ascii", "backslashreplace").decode()


def _layout(lines: list[list[str]], path: Path) -> tuple[str, int, np.dtype]:
    """Kind of body, number of vertices and the type of one of them."""
    layout = next((words[1] for words in lines if len(words) > 1 and words[0] == "format"), "missing")
    if layout not in ("ascii", "binary_little_endian"):
        raise InputError(f"'{path}' has format {layout}, save it as binary_little_endian.")
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if first[1:2] != ["vertex"] or len(first) != 3 or not first[2].isdecimal() or len(first[2]) > MOST_DIGITS:
        raise InputError(f"'{path}' does not begin with vertices, save it as a plain point cloud.")
    stop = elements[1] if len(elements) > 1 else len(lines)
    properties = [words for words in lines[elements[0] : stop] if words[:1] == ["property"]]
    unknown = next((words for words in properties if len(words) != 3 or words[1] not in TYPES), None)
    if unknown is not None:
        raise InputError(f"'{path}' has '{' '.join(unknown)}', only scalar vertex properties can be read.")
    if not properties or len({name for _, _, name in properties}) < len(properties):
        raise InputError(f"'{path}' names no vertex property or one twice, export it anew.")
    return layout, int(first[2]), np.dtype([(name, f"<{TYPES[kind]}") for _, kind, name in properties])


def _binary(data: bytes, body: int, count: int, table: np.dtype, path: Path) -> np.ndarray:
    if len(data) - body < count * table.itemsize:
        present = (len(data) - body) // table.itemsize
        raise InputError(f"'{path}' ends after {present} of {count} vertices, copy or export it anew.")
    return np.frombuffer(data, table, count, body)


def _ascii(body: bytes, count: int, table: np.dtype, path: Path) -> np.ndarray:
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()][:count]
    if len(lines) < count:
        raise InputError(f"'{path}' ends after {len(lines)} of {count} vertices, copy or export it anew.")
    try:
        return np.loadtxt(lines, table, ndmin=1) if lines else np.empty(0, table)
    except ValueError as problem:
        raise InputError(f"'{path}' has an unreadable vertex ({problem}), export it anew.") from None
