"""Sums over the entries of a list, row by row, in a fixed order."""

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from gsx.core.shapes import Float, Int


def edges_of(counts: Int[Tensor, "N"]) -> Int[Tensor, "N_1"]:
    """Returns the first entry of each row with that many entries, then the end of the last."""
    ends = counts.cumsum(0)
    return torch.cat([torch.zeros_like(ends[:1]), ends])


def bag_sums(values: Float[Tensor, "E V"], places: Int[Tensor, "P"], edges: Int[Tensor, "N_1"]) -> Float[Tensor, "N V"]:
    """Sums values[places[edges[n] : edges[n + 1]]] into row n; the last edge is P."""
    return embedding_bag(places, values, edges[:-1].to(places), mode="sum")


def sum_runs(values: Float[Tensor, "M V"], ids: Int[Tensor, "M"], count: int) -> Float[Tensor, "N V"]:
    """Sums the values of each id into a row; ids ascend. Does not wait for the device."""
    rows = torch.arange(count + 1, device=ids.device, dtype=ids.dtype)
    return bag_sums(values, torch.arange(len(ids), device=ids.device), torch.searchsorted(ids, rows))
