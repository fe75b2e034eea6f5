"""Turned Gaussians look the same to a turned camera."""

import pytest
import torch
from torch.nn.functional import normalize

from gsx.core.gaussians.quaternions import quaternions_of, rotation_matrices
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Gaussians
from gsx.formats.turned import rotation_between, turned


def random_rotations(count: int, seed: int = 0) -> torch.Tensor:
    values = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return rotation_matrices(values)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_shapes_and_colours_turn_with_the_scene(bands: int) -> None:
    g = torch.Generator().manual_seed(bands)
    made = Gaussians(
        means=torch.randn(5, 3, generator=g), log_scales=torch.randn(5, 3, generator=g),
        quats=torch.randn(5, 4, generator=g), opacity_logits=torch.randn(5, generator=g),
        sh_dc=torch.randn(5, 3, generator=g), sh_rest=0.2 * torch.randn(5, bands, 3, generator=g),
    )  # fmt: skip
    rotation = random_rotations(1)[0]
    after = turned(made, rotation)
    assert torch.allclose(after.means.double(), made.means.double() @ rotation.T, atol=1e-6)

    def covariances(one: Gaussians) -> torch.Tensor:
        axes = rotation_matrices(one.quats.double()) * one.log_scales.double().exp()[:, None]
        return axes @ axes.mT

    expected = rotation @ covariances(made) @ rotation.T
    assert torch.allclose(covariances(after), expected, rtol=1e-4, atol=1e-5)
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[bands]
    for direction in normalize(torch.randn(20, 3, generator=g), dim=1):
        seen = colours_of(made.sh_dc[:, None], made.sh_rest, direction.expand(5, 3), degree)
        again = colours_of(
            after.sh_dc[:, None], after.sh_rest, (rotation @ direction.double()).float().expand(5, 3), degree
        )
        assert torch.allclose(seen, again, atol=1e-5)


def test_quaternions_of_matrices_are_their_inverse() -> None:
    half_turns = torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]]).double())
    matrices = torch.cat([random_rotations(100, seed=1), half_turns])
    quats = quaternions_of(matrices)
    assert torch.allclose(quats.norm(dim=1), torch.ones(104, dtype=torch.float64))
    assert torch.allclose(rotation_matrices(quats), matrices, atol=1e-12)
    # by hand: a quarter turn about z takes x to y
    quarter = torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]], dtype=torch.float64)
    assert quaternions_of(quarter)[0].tolist() == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5])


def test_the_smallest_rotation_between_two_directions() -> None:
    a, b = (normalize(torch.tensor(v, dtype=torch.float64), dim=0) for v in ([1.0, 2, 3], [-2.0, 0.5, 1]))
    rotation = rotation_between(a, b)
    assert torch.allclose(rotation @ a, b)
    assert torch.allclose(rotation @ torch.linalg.cross(a, b), torch.linalg.cross(a, b))  # its axis
    for a in (torch.tensor([0.0, 0, 1]), torch.tensor([0.6, 0.8, 0])):
        opposite = rotation_between(a, -a)
        assert torch.allclose(opposite @ a.double(), -a.double())
        assert float(torch.linalg.det(opposite)) == pytest.approx(1)
        assert torch.allclose(rotation_between(a, a), torch.eye(3, dtype=torch.float64))
