"""Deterministic k-means: code books of numbers and of vectors."""

import numpy as np
import torch

from gsx.core.shapes import Float, Int

NUMBER_ROUNDS, VECTOR_ROUNDS = 20, 8
"""Rounds of Lloyd's algorithm."""
CHUNK_VALUES = 1 << 24
"""Distances held at once."""


def number_book(values: Float[np.ndarray, "V"], size: int) -> Float[np.ndarray, "size"]:
    """Returns an ascending code book by k-means, from quantiles (dense values) and even steps (sparse ones)."""
    ordered, half = np.sort(values), size // 2
    even = np.linspace(ordered[0], ordered[-1], size - half)
    book = np.sort(np.concatenate([np.quantile(ordered, (np.arange(half) + 0.5) / half), even]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(NUMBER_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, (sums[ends[1:]] - sums[ends[:-1]]) / np.maximum(counts, 1), book)
    return book


def nearest_number(values: Float[np.ndarray, "..."], book: Float[np.ndarray, "size"]) -> Int[np.ndarray, "..."]:
    """Returns the index of the nearest number in an ascending book."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values)


def vector_book(
    vectors: Float[np.ndarray, "N D"], size: int
) -> tuple[Float[np.ndarray, "size D"], Int[np.ndarray, "N"]]:
    """Returns (code book, row of the nearest entry of each vector) by k-means from evenly spaced rows."""
    points = torch.from_numpy(vectors.astype(np.float32))
    book = points[torch.arange(size) * len(points) // size].clone()
    labels = nearest_vector(points, book)
    for _ in range(VECTOR_ROUNDS if size < len(points) else 0):
        counts = torch.bincount(labels, minlength=size)
        sums = torch.zeros_like(book).index_add_(0, labels, points)
        book = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1)[:, None], book)
        labels = nearest_vector(points, book)
    return book.numpy().astype(float), labels.numpy()


def nearest_vector(points: Float[torch.Tensor, "N D"], book: Float[torch.Tensor, "K D"]) -> Int[torch.Tensor, "N"]:
    """Returns the row of the nearest vector in a book."""
    squares = book.square().sum(1)
    rows = max(1, CHUNK_VALUES // len(book))
    return torch.cat([(squares - 2 * part @ book.T).argmin(1) for part in points.split(rows)])
