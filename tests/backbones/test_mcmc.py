"""MCMC against float64 formulas, numbers worked by hand, gsplat's own functions, and what it must not depend on."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from small_scene import published_options, small_gs3d, small_scene, spread
from tiny import LIGHT, same_ending, stopped_at, tiny_run, tiny_settings
from torch import Tensor

from gsx.backbones import mcmc
from gsx.backbones.gs3d import GS3D
from gsx.backbones.gs3d_options import GS3DOptions, MCMCOptions
from gsx.backbones.mcmc import add_noise, draw_by_opacity, profile_integral, relocate, shares
from gsx.core.data.camera import look_at
from gsx.core.errors import ConfigError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import RasterSettings, rasterize
from gsx.core.training.parameter_table import ParameterTable, table_tensors
from gsx.experiments.run_folder.run_key import composition_key

GOLDEN = load_file(Path(__file__).parents[1] / "golden" / "mcmc.safetensors")
NAMES = {"means": "means", "scales": "log_scales", "quats": "quats", "opacities": "opacity_logits", "sh0": "sh_dc"}
NAMES |= {"shN": "sh_rest"}
"""Parameters of gsplat and ours."""
BRIGHT = ("backbone.capacity=mcmc", "backbone.mcmc.primitives=200")


def options_of(primitives: int = 1000, **more: Any) -> GS3DOptions:
    return replace(published_options(), capacity="mcmc", mcmc=MCMCOptions(primitives=primitives, **more))


def small(opacities: list[float], *, iterations: int = 30000, extent: float = 1.0, **more: Any) -> GS3D:
    """A Gaussian for each opacity, told apart by sh_dc = row number; Adam has taken a step at rate 0."""
    scene = small_scene(spread(len(opacities)), extent=extent)
    model = small_gs3d(scene, options=options_of(**more), iterations=iterations)
    table, g = model.table, torch.Generator().manual_seed(1)
    with torch.no_grad():
        table["sh_dc"].copy_(torch.arange(float(len(table)))[:, None, None].expand(-1, 1, 3))
        table["quats"].normal_(generator=g)
        table["log_scales"].copy_(torch.randn(len(table), 3, generator=g) * 0.5 - 3)
        table["opacity_logits"].copy_(torch.tensor(opacities).logit())
    for parameter in table.parameters.values():
        parameter.grad = torch.randn(parameter.shape, generator=g)
    table.optimiser.step()
    return model


def moments(table: ParameterTable, name: str, rows: list[int]) -> Tensor:
    return table.optimiser.state[table.parameters[name]]["exp_avg"][rows]


# -- what a relocated Gaussian becomes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("opacity", "count", "less", "integral", "shrink"),
    [
        (0.5, 2, 0.292893, 0.525126, 0.952152),
        (0.9, 2, 0.683772, 1.036941, 0.867938),
        (0.9, 4, 0.437659, 1.113233, 0.808456),
        (0.95, 4, 0.527129, 1.229290, 0.772804),
        (0.99, 11, 0.342067, 1.489967, 0.664444),
        (0.5, 51, 0.013499, 0.550026, 0.909049),
        (0.006, 2, 0.005, 0.009982, 0.601062),  # clamped first: the pair is not brighter than one was
    ],
)
def test_opacity_and_scale_worked_by_hand(
    opacity: float, count: int, less: float, integral: float, shrink: float
) -> None:
    logits, counts = torch.tensor([opacity], dtype=torch.float64).logit(), torch.tensor([count])
    found = shares(logits, counts, 0.005)
    expected = (less, integral, shrink)
    assert (float(found[0]), float(profile_integral(found[0], counts)), float(found[1])) == pytest.approx(
        expected, abs=1e-6
    )


def test_the_integral_is_the_sum_of_equation_9() -> None:
    """The published double sum, its terms added exactly."""
    for count in range(1, 52):
        for opacity in (0.005, 0.3, 0.9, 0.99, 1 - 1e-7):
            x = 1 - (1 - opacity) ** (1 / count)
            terms = [
                math.comb(i - 1, k) * (-1) ** k * x ** (k + 1) / math.sqrt(k + 1)
                for i in range(1, count + 1)
                for k in range(i)
            ]
            found = profile_integral(torch.tensor([x], dtype=torch.float64), torch.tensor([count]))
            assert float(found) == pytest.approx(math.fsum(terms), rel=1e-8)


@pytest.mark.parametrize(("opacity", "least", "most"), [(0.5, 0.005, 0.007), (0.9, 0.03, 0.042)])
def test_a_render_hardly_changes(opacity: float, least: float, most: float) -> None:
    """One white Gaussian, 12 px wide, and a dead one elsewhere that joins it; a plain copy would add 0.25 or 0.09."""
    model = small([opacity, 0.001])
    table, camera = model.table, look_at([0, -4, 0], [0, 0, 0], fov_x=0.5, width=96, height=64)
    with torch.no_grad():
        table["means"].copy_(torch.tensor([[0.0, 0, 0], [9, 9, 9]]))
        table["log_scales"].fill_(math.log(0.25))
        table["sh_dc"].fill_(0.5 / 0.28209479)
    rules = RasterSettings(cull="tight", alpha_min=1e-12, transmittance_stop=0.0)

    def render() -> Tensor:
        return rasterize(model.draw(camera, 1).splats, camera, rules, background=torch.zeros(3)).image.detach()

    before = render()
    assert relocate(table, 0.005, torch.Generator()) == 1
    assert torch.equal(table["means"][0], table["means"][1])
    assert least < float((render() - before).abs().max()) < most


def test_relocation_copies_noise_and_moments_are_those_of_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose kernel sums in float32. Moments of dead rows, which it keeps, are 0 here."""
    model = small([0.5] * 12)
    table = model.table
    for name, own in NAMES.items():
        with torch.no_grad():
            table[own].copy_(GOLDEN[f"start.{name}"])
        for moment in ("exp_avg", "exp_avg_sq"):
            table.optimiser.state[table.parameters[own]][moment].copy_(GOLDEN[f"start.{name}.{moment}"])

    def compare(stage: str) -> None:
        for name, own in NAMES.items():
            torch.testing.assert_close(table[own].detach(), GOLDEN[f"{stage}.{name}"].float(), rtol=1e-5, atol=2e-6)
            for moment, found in table.optimiser.state[table.parameters[own]].items():
                if moment != "step":
                    expected = GOLDEN[f"{stage}.{name}.{moment}"].float()
                    expected[[2, 4, 6, 10]] = 0
                    torch.testing.assert_close(found, expected)

    for stage, drawn in (("relocated", "moved"), ("added", "copied")):
        monkeypatch.setattr(mcmc, "draw_by_opacity", lambda *_, drawn=drawn: GOLDEN[drawn])
        if stage == "relocated":
            relocate(table, 0.005, torch.Generator())
        else:
            model.control.growth = 17 / 12
            assert model.control.add(model, 600) == {"added": 5}
        compare(stage)
    monkeypatch.setattr(torch, "randn", lambda *_, **__: GOLDEN["noise"])
    add_noise(table, 1.6e-4 * 5e5, 0.005, torch.Generator())
    compare("noisy")


# -- who is relocated, who is drawn ------------------------------------------------------------------------------------


def test_dead_rows_become_copies_and_others_stay() -> None:
    model = small([0.9, 0.004, 0.5, 0.001, 0.6])
    table = model.table
    table.columns["sh_degree"] = torch.tensor([0, 1, 2, 3, 4], dtype=torch.int8)
    before, steps = {name: table[name].detach().clone() for name in table.parameters}, 1.0
    assert relocate(table, 0.005, torch.Generator().manual_seed(3)) == 2
    donors = table["sh_dc"].detach()[[1, 3], 0, 0].int().tolist()
    assert set(donors) <= {0, 2, 4}
    assert table["sh_degree"][[1, 3]].tolist() == donors
    for name in table.parameters:
        values = table[name].detach()
        assert torch.equal(values[[1, 3]], values[donors])
        assert not moments(table, name, [1, 3, *donors]).any()
        rest = [row for row in (0, 2, 4) if row not in donors]
        assert torch.equal(values[rest], before[name][rest])
        assert all(values.any() for values in moments(table, name, rest))
        assert float(table.optimiser.state[table.parameters[name]]["step"]) == steps


@pytest.mark.parametrize("opacities", [[0.9, 0.006, 0.5], [0.005, 0.001, 0.002]])
def test_without_dead_or_without_living_nothing_moves(opacities: list[float]) -> None:
    model = small(opacities)
    before = {name: value.clone() for name, value in table_tensors(model.table).items()}
    assert relocate(model.table, 0.00501, torch.Generator()) == 0
    assert all(torch.equal(before[name], value) for name, value in table_tensors(model.table).items())


def test_donors_are_drawn_by_opacity() -> None:
    table = small([0.2, 0.6, 0.7, 0.8]).table
    rows = draw_by_opacity(table, torch.tensor([1, 1, 0, 1]).bool(), 40000, torch.Generator().manual_seed(0))
    shares_of_rows = rows.bincount(minlength=4) / 40000
    torch.testing.assert_close(shares_of_rows, torch.tensor([0.125, 0.375, 0.0, 0.5]), atol=0.01, rtol=0)


@pytest.mark.parametrize(("primitives", "added"), [(1000, 2), (41, 1), (40, 0), (30, 0)])
def test_an_event_adds_a_twentieth_up_to_the_number(primitives: int, added: int) -> None:
    model = small([0.5] * 40, primitives=primitives)
    old = moments(model.table, "sh_dc", list(range(40))).clone()
    assert model.control.add(model, 600) == {"added": added}
    assert torch.equal(moments(model.table, "sh_dc", list(range(40))), old)  # gsplat; the authors zero the parents'
    assert not moments(model.table, "sh_dc", list(range(40, 40 + added))).any()


def test_the_sky_is_neither_moved_nor_copied_nor_weighed() -> None:
    model = small([0.001, 0.02, 0.001, 0.999])  # the sky would be drawn first
    sky = torch.tensor([0, 0, 1, 1], dtype=torch.int8)
    model.table.columns["sky"] = sky
    before = model.table["means"].detach()[2:].clone()
    assert relocate(model.table, 0.005, torch.Generator()) == 1
    add_noise(model.table, 1e6, 0.005, torch.Generator())
    assert torch.equal(model.table["means"][2:], before)
    assert model.table["sh_dc"].detach()[:2, 0, 0].tolist() == [1, 1]
    model.control.regulariser(model.table).backward()
    gradient = model.table["log_scales"].grad.norm(dim=1)
    assert (gradient > 0).tolist() == [True, True, False, False]


# -- noise and regularisers --------------------------------------------------------------------------------------------


def test_noise_has_the_deviation_of_a_squared_covariance() -> None:
    """40,000 dead Gaussians turned by 30 degrees about z: covariance of the noise is Sigma^2 (gate x factor)^2."""
    table = small([0.5]).table
    turn = torch.tensor([[math.cos(math.pi / 6), -0.5, 0], [0.5, math.cos(math.pi / 6), 0], [0, 0, 1]])
    variances = torch.tensor([0.04, 0.01, 0.0025])
    rows = {"means": torch.zeros(3), "log_scales": variances.log() / 2, "opacity_logits": torch.tensor(0.01).logit()}
    rows |= {"quats": 2 * torch.tensor([math.cos(math.pi / 12), 0, 0, math.sin(math.pi / 12)])}
    many = {name: value.expand(40000, *value.shape).contiguous() for name, value in rows.items()}
    noisy = ParameterTable({name: torch.nn.Parameter(value) for name, value in many.items()})
    add_noise(noisy, 80.0, 0.005, torch.Generator().manual_seed(0))
    sigma = turn @ variances.diag() @ turn.T
    expected = (80 / (1 + math.exp(0.5))) ** 2 * sigma @ sigma
    torch.testing.assert_close(noisy["means"].detach().T.cov(), expected, rtol=0.03, atol=0.005 * float(expected.max()))
    assert table is not noisy


@pytest.mark.parametrize(
    ("opacity", "gate"), [(0.0, 0.622), (0.005, 0.5), (0.01, 0.378), (0.02, 0.182), (0.05, 0.011), (0.5, 0.0)]
)
def test_opaque_gaussians_do_not_move(opacity: float, gate: float) -> None:
    faint, other = small([opacity]).table, small([0.005]).table
    for table in (faint, other):
        with torch.no_grad():
            table["means"].zero_()
        add_noise(table, 80.0, 0.005, torch.Generator().manual_seed(0))
    ratio = (faint["means"] / other["means"]).detach()
    torch.testing.assert_close(ratio, torch.full((1, 3), 2 * gate), atol=1.1e-3, rtol=0)


def test_noise_follows_the_rate_of_the_means_and_its_pace() -> None:
    """At half of the run and an extent of 5, a deviation of a fifth of a scale of 0.01."""
    model = small([0.005] * 3000, extent=5.0)
    with torch.no_grad():
        model.table["means"].zero_()
        model.table["log_scales"].fill_(math.log(0.01))
    model.set_rates(15000)
    model.table.pace = 0.5
    model.control.perturb(model.table)
    assert float(model.table["means"].detach().std()) == pytest.approx(0.5 * 0.2 * 0.01, rel=0.03)


def test_regularisers_are_means_over_all_gaussians() -> None:
    model = small([0.5, 0.1], extent=5.0)
    with torch.no_grad():
        model.table["log_scales"].copy_(torch.tensor([[1.0, 2, 3], [4, 5, 9]]).log())
    assert model.control.regulariser(model.table).item() == pytest.approx(0.01 * 0.3 + 0.01 * 4)
    drawn = model.draw(model.context.scene.train[0].camera, 1)
    assert model.regulariser(drawn).item() == pytest.approx(0.043)


def trajectory(unit: float, reference: float) -> Tensor:
    """Means after twelve steps of a world `unit` times as large, over the unit."""
    scene = small_scene(unit * spread(30), extent=2 * unit, views=1)
    camera = look_at([0, -4 * unit, unit], [0, 0, 0], fov_x=0.9, width=24, height=16)
    mcmc_options = {"extent": reference, "start": 0, "every": 5000, "initial_opacity": 0.01, "dead_opacity": 0.005}
    model = small_gs3d(scene, iterations=12, options=options_of(60, **mcmc_options))
    for step in range(1, 13):
        drawn = model.draw(camera, step)
        rendering = rasterize(drawn.splats, camera, model.raster, background=torch.ones(3))
        (photometric(rendering.image, torch.full_like(rendering.image, 0.2), 0.2) + model.regulariser(drawn)).backward()
        model.densify_and_prune(step)
        model.update(step)
    return model.table["means"].detach() / unit


def test_a_tenfold_world_trains_the_same() -> None:
    """With the reference extent; without, as published, noise is a hundred times stronger, in sizes of Gaussians."""
    same, other = (trajectory(10.0, reference) - trajectory(1.0, reference) for reference in (5.0, 0.0))
    assert float(same.abs().max()) < 2e-3
    assert float(other.abs().max()) > 0.1


# -- schedule, options, runs -------------------------------------------------------------------------------------------


def test_events_and_growth_are_published_and_shrink_with_the_run() -> None:
    whole, short = (small([0.5], iterations=steps).control for steps in (30000, 1000))
    due = [step for step in range(1, 30001) if whole.events.due(step)]
    assert (due[0], due[-1], len(due)) == (600, 24900, 244)
    assert whole.growth == 1.05
    assert whole.growth**48 == pytest.approx(10, abs=0.5)
    assert short.events.every == 3
    assert short.growth ** short.events.count() == pytest.approx(1.05**244, rel=0.05)
    assert (whole.initial_opacity, whole.initial_scale) == (0.5, 0.1)
    assert short.initial_scale == pytest.approx(0.1 ** (1 / 30))  # time to grow: the same share of the run
    assert short.plan()["mcmc"]["until"] == 833
    assert "0 points" not in str(short.plan())


def test_a_model_starts_half_opaque_and_small() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    table = small_gs3d(small_scene(points), options=options_of()).table
    torch.testing.assert_close(table["opacity_logits"].detach(), torch.zeros(4))
    sizes = 0.1 * (torch.tensor([14.0, 16, 22, 32]) / 3).sqrt()
    torch.testing.assert_close(table["log_scales"].detach().exp(), sizes[:, None].expand(4, 3))


def test_an_event_follows_the_adam_step() -> None:
    """gsplat's order: every row, also a relocated one, holds a value that has taken one step. The authors lose it."""
    model = small([0.9, 0.001, 0.004, 0.5, 0.4], primitives=5)
    model.table.optimiser.state.clear()
    for parameter in model.table.parameters.values():
        parameter.grad = torch.full_like(parameter, 1e-6)
    assert model.densify_and_prune(600) == {"relocated": 2, "added": 0}
    model.update(600)
    values = model.table["sh_dc"].detach()[:, 0, 0]
    assert {0, 3, 4} >= set(values[[1, 2]].round().int().tolist())
    torch.testing.assert_close(values - values.round(), torch.full((5,), -0.0025))
    assert {float(state["step"]) for state in model.table.optimiser.state.values()} == {1.0}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("backbone.capacity=mcmc",), "capacity is mcmc and backbone.mcmc.primitives 0: give both, capacity=mcmc and"),
        (("backbone.mcmc.primitives=9",), "capacity is published and backbone.mcmc.primitives 9: give both"),
        (("backbone.capacity=mcmc", "backbone.mcmc.primitives=6000000"), "above backbone.max_primitives 5000000"),
        (("backbone=scaffold", "backbone.capacity=mcmc"), "'mcmc'; choose published, budget, adaptive, or mcmc with"),
        (
            ("backbone=octree_gs3d", "backbone.densification=clone_split", "backbone.capacity=mcmc"),
            "or mcmc with backbone=gs3d, gs3d_zoom or mip_splatting",
        ),
    ],
)
def test_what_has_no_chain_is_refused(words: tuple[str, ...], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint):
        tiny_settings(tmp_path, *words)


def test_more_points_than_primitives_are_a_caution() -> None:
    assert "the scene has 40 points" in small([0.5] * 40, primitives=30).plan()["mcmc"]["caution"]


def test_options_without_effect_change_no_name(tmp_path: Path) -> None:
    def key(*words: str) -> str:
        settings = tiny_settings(tmp_path, *words)
        return composition_key(settings.resolved, "", settings.idle)

    older = tiny_settings(tmp_path)
    without = {**older.resolved["backbone"]}
    del without["mcmc"]
    assert composition_key(older.resolved | {"backbone": without}, "", older.idle) == key()
    assert key("backbone.mcmc.noise=7") == key() != key(*BRIGHT) != key(*BRIGHT, "backbone.mcmc.noise=7")


@pytest.mark.parametrize(
    "words",
    [("backbone=gs3d", "backbone.sh_judged=0.5"), ("backbone=gs3d_zoom",), ("backbone=mip_splatting", "preset=zoom")],
    ids=["plain", "zoom", "mip"],
)
def test_runs_reach_their_number_and_resume_bit_for_bit(words: tuple[str, ...], tmp_path: Path) -> None:
    words = (*words, *BRIGHT, *LIGHT, "iterations=12", "backbone.mcmc.dead_opacity=0.45", "rasterizer=eager")
    tiny_run(tmp_path / "whole", words, evaluated=False)
    stopped_at(tmp_path / "parts", words, 5, 7)
    assert len(same_ending(tmp_path / "whole", tmp_path / "parts")["parameters.means"]) == 200
    lines = (tmp_path / "whole" / "metrics.jsonl").read_text()
    assert '"relocated"' in lines
