"""Files with a few bytes or words changed, the same for the same seed."""

import random

WORDS = [b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"null", b"true", b"[]", b"{}", b'""',
         b'"\xff"', b"[[[[", b"}}}}", b"..", b"/", b"\n", b"\r\n", b"\x00", b"\xef\xbb\xbf", b"1.5", b'"a"', b"[1, 2]",
         b"#", b" "]  # fmt: skip
NUMBERS = [b"\x00" * 4, b"\xff" * 4, b"\x00" * 8, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f",
           b"\x00\x00\x80\x7f",
           b"\x00\x00\xc0\x7f", b"\x00" * 6 + b"\xf0\x7f", b"\x00" * 6 + b"\xf8\x7f", b"\x00\x00\x00\x40" + b"\x00" * 4,
           b"\xff" * 7 + b"\x7f"]  # fmt: skip
"""Limits of integers, infinities and nan, in both orders of bytes."""


def mutated(content: bytes, choice: random.Random) -> bytes:
    """One to four changes, more often near the beginning, where headers are."""
    for _ in range(choice.choice([1, 1, 1, 2, 4])):
        content = choice.choice(CHANGES)(content, choice)
    return content


def somewhere(content: bytes, choice: random.Random) -> int:
    """A position; every second time among the first 200 bytes."""
    end = len(content) if choice.random() < 0.5 else min(len(content), 200)
    return choice.randrange(end + 1)


def flipped(content: bytes, choice: random.Random) -> bytes:
    """One bit."""
    if not content:
        return content
    at = min(somewhere(content, choice), len(content) - 1)
    return content[:at] + bytes([content[at] ^ 1 << choice.randrange(8)]) + content[at + 1 :]


def overwritten(content: bytes, choice: random.Random) -> bytes:
    """A number at its limits in place of some bytes."""
    at, number = somewhere(content, choice), choice.choice(NUMBERS)
    return content[:at] + number + content[at + len(number) :]


def without(content: bytes, choice: random.Random) -> bytes:
    """Some bytes removed."""
    at = somewhere(content, choice)
    return content[:at] + content[at + choice.choice([1, 2, 4, 8, 64, 1024]) :]


def doubled(content: bytes, choice: random.Random) -> bytes:
    """Some bytes twice."""
    at = somewhere(content, choice)
    part = content[at : at + choice.choice([1, 4, 16, 64, 256])]
    return content[:at] + part * choice.choice([2, 2, 50]) + content[at + len(part) :]


def cut(content: bytes, choice: random.Random) -> bytes:
    """Ends early."""
    return content[: somewhere(content, choice)]


def word_replaced(content: bytes, choice: random.Random) -> bytes:
    """A word, a number or a quoted text, as files of text have them, by another."""
    at = somewhere(content, choice)
    ends = [i for i in range(at, min(len(content), at + 60)) if content[i : i + 1] in b" ,:]}\n\t"]
    if len(ends) < 2:
        return content[:at] + choice.choice(WORDS) + content[at:]
    return content[: ends[0] + 1] + choice.choice(WORDS) + content[ends[1] :]


def lines_exchanged(content: bytes, choice: random.Random) -> bytes:
    """Two lines in the wrong order, or one twice."""
    lines = content.split(b"\n")
    if len(lines) < 3:
        return flipped(content, choice)
    i, j = choice.randrange(len(lines)), choice.randrange(len(lines))
    if choice.random() < 0.5:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines.insert(i, lines[j])
    return b"\n".join(lines)


CHANGES = [flipped, overwritten, without, doubled, cut, word_replaced, word_replaced, lines_exchanged]
"""Ways to change a file."""
