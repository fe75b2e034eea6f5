"""Sums over the entries of a list, row by row, always in the same order."""

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from gsx.core.shapes import Float, Int

SPARE = 64
"""Entries behind a list are summed in bags of so many: a GPU walks through a bag by itself, whatever its length."""


def edges_of(counts: Int[Tensor, "N"]) -> Int[Tensor, "N_1"]:
    """Where each row of a list begins that has so many entries, and where the last one ends."""
    ends = counts.cumsum(0)
    return torch.cat([torch.zeros_like(ends[:1]), ends])


def bag_sums(
    values: Float[Tensor, "E V"], places: Int[Tensor, "P"], edges: Int[Tensor, "N_1"], spare: bool
) -> Float[Tensor, "N V"]:
    """Row n is the sum of values[places[edges[n] : edges[n + 1]]]. `spare`: there may be places behind the last edge,
    and edges behind the last place."""
    count, edges = len(edges) - 1, edges.to(places)
    if not spare:
        return embedding_bag(places, values, edges[:-1], mode="sum")
    edges = edges.clamp_max(len(places))
    more = torch.arange(SPARE, max(SPARE + 1, len(places)), SPARE, device=edges.device, dtype=edges.dtype)
    offsets = torch.cat([edges, more.maximum(edges[-1]).clamp_max(len(places))])
    return embedding_bag(places, values, offsets, mode="sum")[:count]


def runs_added(values: Float[Tensor, "M V"], ids: Int[Tensor, "M"], count: int) -> Float[Tensor, "N V"]:
    """Row n is the sum of the values whose id is n; ids ascend. Always in the same order, without asking the device."""
    rows = torch.arange(count + 1, device=ids.device, dtype=ids.dtype)
    return bag_sums(values, torch.arange(len(ids), device=ids.device), torch.searchsorted(ids, rows), spare=False)
