"""Damaged COLMAP models, text and binary: gsx loads what is left or says what is wrong; nothing else comes out.

GSX_FUZZ sets how many damaged models are tried.
"""

import os
import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic_colmap import colmap_options, synthesize, write_photos

from gsx.core.data.scene import Scene
from gsx.core.errors import GsxError
from gsx.scenes.colmap import facts, image_folder, load
from gsx.scenes.colmap_folders import find_model
from gsx.scenes.colmap_model import read_model

TRIES = int(os.environ.get("GSX_FUZZ", "60"))
FILES = ("cameras", "images", "points3D", "rigs", "frames")
ODD_WORDS = (
    b"-1", b"nan", b"inf", b"1e400", b"999999999999999999999", b"\xff\xfe", b"CAMERA", b"SIMPLE_RADIAL", b"",
    b"4294967296", b"0.5", b"#", b"\x00", b"1 1 1", b"\n", b"-", "é".encode(),
)  # fmt: skip
ODD_NUMBERS = (0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
LONGEST = 2000
"""Letters of an error."""
Damage = Callable[[bytes, random.Random], bytes]


def cut(content: bytes, dice: random.Random) -> bytes:
    return content[: dice.randrange(len(content) + 1)]


def flip(content: bytes, dice: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(dice.choice((1, 1, 2, 8)) if out else 0):
        out[dice.randrange(len(out))] ^= 1 << dice.randrange(8)
    return bytes(out)


def shuffle(content: bytes, dice: random.Random) -> bytes:
    start, stop = sorted(dice.randrange(len(content) + 1) for _ in range(2))
    return content[:start] + content[stop:] + content[start:stop]


def repeat(content: bytes, dice: random.Random) -> bytes:
    start, stop = sorted(dice.randrange(len(content) + 1) for _ in range(2))
    return content[:stop] + content[start:]


def odd_number(content: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(content) // 4 + 1) * 4
    kinds = [struct.pack("<Q", dice.choice(ODD_NUMBERS)), struct.pack("<d", dice.choice((float("nan"), 1e308, -1.0)))]
    return content[:at] + dice.choice(kinds)[: len(content) - at] + content[at + 8 :]


def odd_word(content: bytes, dice: random.Random) -> bytes:
    lines = content.split(b"\n")
    at = dice.randrange(len(lines))
    words = lines[at].split(b" ")
    words[dice.randrange(len(words))] = dice.choice(ODD_WORDS)
    lines[at] = b" ".join(words)
    return b"\n".join(lines)


def drop_line(content: bytes, dice: random.Random) -> bytes:
    lines = content.split(b"\n")
    del lines[dice.randrange(len(lines))]
    return b"\n".join(lines)


def empty(content: bytes, dice: random.Random) -> bytes:
    return b""


BINARY: tuple[Damage, ...] = (cut, flip, flip, shuffle, repeat, odd_number, odd_number, empty)
TEXT: tuple[Damage, ...] = (cut, flip, shuffle, repeat, odd_word, odd_word, odd_word, drop_line, drop_line, empty)


def damage(model: Path, whole: dict[str, bytes], text: bool, dice: random.Random) -> str:
    """Write a damaged model; returns what was done."""
    suffix = ".txt" if text else ".bin"
    names = [name for name in whole if dice.random() < 0.85 or name in FILES[:3]]
    for file in model.iterdir():
        file.unlink()
    for name in names:
        (model / f"{name}{suffix}").write_bytes(whole[name])
    done = [f"{names}"]
    if dice.random() < 0.1:
        one, other = dice.sample(names, 2)
        (model / f"{one}{suffix}").rename(model / f"{other}{suffix}")
        done.append(f"{one} as {other}")
    for _ in range(dice.choice((1, 1, 2))):
        file = model / f"{dice.choice(names)}{suffix}"
        change = dice.choice(TEXT if text else BINARY)
        if file.exists():
            file.write_bytes(change(file.read_bytes(), dice))
            done.append(f"{file.name}: {change.__name__}")
    return "; ".join(done)


@pytest.mark.parametrize("text", [False, True])
def test_damaged_models_are_loaded_or_explained(tmp_path: Path, text: bool) -> None:
    reconstruction = synthesize("SIMPLE_RADIAL", [80.0, 32.0, 24.0, 0.05], cameras=2, frames=2)
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(model)
    whole = {file.stem: file.read_bytes() for file in sorted(model.iterdir())}
    write_photos(reconstruction, tmp_path / "images")
    options, loaded = colmap_options(tmp_path), 0
    first = int(os.environ.get("GSX_FUZZ_FROM", "0"))
    for seed in range(first, first + TRIES):
        done = damage(model, whole, text, random.Random(seed))
        try:
            loaded += isinstance(load(options), Scene)
            assert list(facts(tmp_path))
            image_folder(tmp_path, read_model(find_model(tmp_path)[0]))
        except GsxError as problem:
            words = str(problem)
            if ".cc:" in words or len(words) > LONGEST:
                raise AssertionError(f"seed {seed}: {done}: {words}") from problem
        except Exception as problem:
            raise AssertionError(f"seed {seed}: {done}: {type(problem).__name__}: {problem}") from problem
    assert loaded > 0
