"""`python -m faults.fuzz READER NUMBER FOLDER RUNS SEED`: what atheris makes of one of a reader's files.

Cases grow out of the sound file by what of gsx they reach; the first that is read neither as something sound nor with
a sentence ends the process with atheris' code for that, 77.
"""

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["gsx"]):
    from faults.test_readers import READERS, problem_of


def main(name: str, number: str, place: str, runs: str, seed: str) -> None:
    """Let atheris try so many cases; words of the command line."""
    reader, folder, corpus = READERS[name], Path(place) / "folder", Path(place) / "corpus"
    folder.mkdir()
    corpus.mkdir()
    path = reader.prepare(folder)[int(number)]
    (corpus / "sound").write_bytes(path.read_bytes())
    assert problem_of(reader.read, folder) == "", "it must be sound before it is damaged"

    def tried(content: bytes) -> None:
        path.write_bytes(content)
        reader.settle(folder)
        problem = problem_of(reader.read, folder)
        if problem:
            (Path(place) / "problem.txt").write_text(problem)
            raise AssertionError(problem)

    limits = [f"-runs={runs}", f"-seed={seed}", "-timeout=20", "-rss_limit_mb=6144", "-max_len=8192"]
    atheris.Setup([name, f"-artifact_prefix={place}/", *limits, str(corpus)], tried)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
