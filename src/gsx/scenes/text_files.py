"""Text files that people write or export, such as lists of photos."""

import codecs
from pathlib import Path

from gsx.core.errors import InputError

MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""Encodings by byte order mark, longer marks first: that of UTF-32 begins with that of UTF-16."""


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, or in the encoding that its byte order mark states, without the mark.

    Raises:
        InputError: the file cannot be read, or is no text in that encoding.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror}): check the file.") from None
    encoding = next((name for mark, name in MARKS.items() if content.startswith(mark)), "utf-8")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"'{path}' is no UTF-8 text at byte {error.start}: save it as UTF-8.") from None
