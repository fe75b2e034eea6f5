"""Pairs of similar photos and attempts to place the rest: made-up descriptors, and models made by pycolmap."""

import logging
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
from synthetic_colmap import shipped

from gsx.experiments.runs.typed import typed
from gsx.scenes import sfm, vocabulary
from gsx.scenes.photos import PhotosOptions
from gsx.scenes.vocabulary import learn_vocabulary, sample_descriptors

PLACES, VISITS, FEATURES = 5, 4, 150


@pytest.fixture(autouse=True)
def few_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learn 64 words, which takes a fraction of a second."""
    monkeypatch.setattr(vocabulary, "WORDS", 64)


def options(**changes: Any) -> PhotosOptions:
    """The shipped configuration with changes."""
    values = shipped("photos") | {"path": "photos", "num_threads": 1, "matcher": "retrieval"} | changes
    made = typed(PhotosOptions, values, "scene")
    assert isinstance(made, PhotosOptions)
    return made


def write_visits(path: Path, features: int = FEATURES) -> dict[int, int]:
    """Write a database of places visited in turn: descriptors of a place differ by noise; places by number of photo."""
    generator = np.random.default_rng(3)
    looks = generator.integers(0, 256, (PLACES, features, 128))
    spots = generator.random((PLACES, features, 2)) * 400
    places = {}
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 500.0, 640, 480)
        camera.camera_id = database.write_camera(camera)
        for number in range(PLACES * VISITS):
            image = pycolmap.Image(name=f"photo {number:02d}.jpg", camera_id=camera.camera_id)
            identity = database.write_image(image)
            places[identity] = number % PLACES
            noisy = np.clip(looks[number % PLACES] + generator.integers(-9, 10, (features, 128)), 0, 255)
            keypoints = np.concatenate([spots[number % PLACES], np.ones((features, 2))], 1)
            database.write_keypoints(identity, keypoints.astype(np.float32))
            sift = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(identity, pycolmap.FeatureDescriptors(sift, noisy.astype(np.uint8)))
    return places


def matched_pairs(path: Path) -> set[tuple[int, int]]:
    with pycolmap.Database.open(path) as database:
        return {pycolmap.pair_id_to_image_pair(number) for number in database.read_num_matches()[0]}


def test_photos_of_one_place_are_matched_whatever_their_names_and_the_threads(tmp_path: Path) -> None:
    """Each photo has as many similar ones as there are other visits of its place: exactly these pairs."""
    for threads in (1, 2):
        database = tmp_path / f"{threads}.db"
        places = write_visits(database)
        chosen = options(num_threads=threads, similar=VISITS - 1)
        with sfm.quiet():
            new = sfm.match_similar(database, chosen.similar, 60, chosen)
        same = {(a, b) for a in places for b in places if a < b and places[a] == places[b]}
        assert {tuple(sorted(pair)) for pair in matched_pairs(database)} == same
        assert new == len(same) == PLACES * VISITS * (VISITS - 1) // 2
        database.with_name("vocabulary.bin").unlink()


def test_only_queries_are_matched_and_only_new_pairs_count(tmp_path: Path) -> None:
    places, chosen = write_visits(tmp_path / "database.db"), options()
    with sfm.quiet():
        new = sfm.match_similar(tmp_path / "database.db", VISITS - 1, 3, chosen, ["photo 07.jpg"])
        again = sfm.match_similar(tmp_path / "database.db", VISITS - 1, 3, chosen, ["photo 07.jpg"])
    pairs = matched_pairs(tmp_path / "database.db")
    assert (new, again) == (VISITS - 1, 0)
    assert all(8 in pair and places[pair[0]] == places[pair[1]] for pair in pairs)


def test_a_seed_decides_the_words_and_thereby_the_pairs(tmp_path: Path) -> None:
    """Compares the more distant of the pairs, too, whose order is a matter of chance."""
    write_visits(tmp_path / "database.db")
    pairs = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        with pycolmap.Database.open(tmp_path / "database.db") as database, sfm.quiet():
            assert learn_vocabulary(database, tmp_path / name, seed)
            pairing = pycolmap.VocabTreePairingOptions()
            pairing.vocab_tree_path, pairing.num_images, pairing.num_threads = tmp_path / name, 9, 1
            pairs.append(pycolmap.VocabTreePairGenerator(pairing, database).all_pairs())
    assert pairs[0] == pairs[1] != pairs[2]


def test_photos_share_the_sample_of_descriptors_evenly(tmp_path: Path) -> None:
    write_visits(tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        some = sample_descriptors(database, 100, np.random.default_rng(0))
        every = sample_descriptors(database, 10**6, np.random.default_rng(0))
        own = [database.read_descriptors(number + 1).data for number in range(PLACES * VISITS)]
    assert some.shape == (100, 128)
    for number, rows in enumerate(own):  # five of each
        assert all((rows == row).all(1).any() for row in some[5 * number : 5 * number + 5])
    assert np.array_equal(every, np.concatenate(own))


def test_photos_without_features_have_no_similar_ones(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_visits(tmp_path / "database.db", features=1)
    with sfm.quiet():
        assert sfm.match_similar(tmp_path / "database.db", 3, 3, options()) == 0
    assert "too few features" in caplog.text
    assert not (tmp_path / "vocabulary.bin").exists()


# attempts to place the rest


class Placed:
    """A model that places photos 0 to count - 1."""

    def __init__(self, count: int) -> None:
        self.count = count

    def num_reg_images(self) -> int:
        return self.count

    def reg_image_ids(self) -> list[int]:
        return list(range(self.count))

    def image(self, number: int) -> Any:
        return SimpleNamespace(name=f"{number}.jpg")


def attempts(
    monkeypatch: pytest.MonkeyPatch, counts: Sequence[int], new_pairs: int = 1, **changes: Any
) -> tuple[int, list[tuple[int, int, list[str]]], list[int]]:
    """Run attempts whose models place `counts` of 10 photos; return what the last places, the matches, the starts."""
    matches, starts, left = [], [], list(counts[1:])

    def match(database: Path, similar: int, total: int, chosen: Any, queries: list[str]) -> int:
        matches.append((similar, total, queries))
        return new_pairs

    def place(database: Path, folder: Path, sparse: Path, count: int, chosen: Any, start: Any) -> dict[int, Any]:
        starts.append(start.num_reg_images() if start else 0)
        return {0: Placed(left.pop(0)), 1: Placed(1)}

    monkeypatch.setattr(sfm, "match_similar", match)
    monkeypatch.setattr(sfm, "_map", place)
    sizes = {f"{number}.jpg": (8, 8) for number in range(10)}
    first = Placed(counts[0]) if counts[0] else None
    best = sfm._retry(first, Path("d"), Path("f"), sizes, options(**changes), Path("w"))
    return best.num_reg_images() if best else 0, matches, starts


def test_remaining_photos_are_matched_until_no_more_are_placed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        best, matches, starts = attempts(monkeypatch, [6, 8, 8, 9], retry_pairs=12)
    assert best == 8
    assert starts == [6, 8]
    assert matches == [(3, 12, [f"{number}.jpg" for number in range(6, 10)]), (6, 12, ["8.jpg", "9.jpg"])]
    assert "sfm: 4 of 10 photos are not placed: matching each with 3 others" in caplog.messages


def test_attempts_end_where_nothing_is_left_to_try(monkeypatch: pytest.MonkeyPatch) -> None:
    assert attempts(monkeypatch, [10]) == (10, [], [])
    assert attempts(monkeypatch, [6, 10])[::2] == (10, [6])
    assert attempts(monkeypatch, [6], new_pairs=0)[::2] == (6, [])
    assert attempts(monkeypatch, [6], retry_pairs=3) == (6, [], [])
    assert attempts(monkeypatch, [6], retry_pairs=0) == (6, [], [])
    assert attempts(monkeypatch, [6], matcher="exhaustive") == (6, [], [])
    assert attempts(monkeypatch, [0, 7, 7])[::2] == (7, [0, 7])  # no model at first
    ((partners, _, _), *_) = attempts(monkeypatch, [9, 9], retry_pairs=10**6)[1]
    assert partners == 9  # everyone else


@pytest.mark.parametrize("points", [100, 20])
def test_mapping_continues_from_a_model(tmp_path: Path, points: int) -> None:
    """One photo has no matches at first; with them it is placed among the others, which keep their numbers.

    COLMAP itself asks for 30 points.
    """
    pycolmap.set_random_seed(0)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_frames_per_rig, settings.num_points3D = 1, 6, 100
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        truth = pycolmap.synthesize_dataset(settings, database)
        late = max(truth.images)
        held = {}
        for other in set(truth.images) - {late}:
            held[other] = database.read_two_view_geometry(other, late)
            database.delete_inlier_matches(other, late)
    sizes = {image.name: (1024, 768) for image in truth.images.values()}
    chosen, shared = options(), (tmp_path / "database.db", tmp_path)
    with sfm.quiet():
        before = sfm.largest(sfm._map(*shared, tmp_path / "sparse", 6, chosen))
        assert sfm.unplaced(before, sizes) == [truth.image(late).name]
        with pycolmap.Database.open(tmp_path / "database.db") as database:
            for other, geometry in held.items():
                geometry.inlier_matches = geometry.inlier_matches[geometry.inlier_matches[:, 1] < points]
                database.update_two_view_geometry(other, late, geometry)
        after = sfm.largest(sfm._map(*shared, tmp_path / "sparse1", 6, chosen, before))
    assert sfm.unplaced(after, sizes) == []
    estimated, true = (
        np.array([model.image(number).projection_center() for number in sorted(truth.images)])
        for model in (after, truth)
    )
    similarity = pycolmap.estimate_sim3d(estimated, true)
    moved = np.array([similarity * centre for centre in estimated])
    assert np.linalg.norm(moved - true, axis=1).max() < 0.05
