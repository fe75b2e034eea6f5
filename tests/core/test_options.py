"""Options that say themselves whether they have an effect."""

from dataclasses import dataclass

from gsx.builtin import plugins
from gsx.core.options import IdleKeys, fields_with, idle_keys, label, without_effect
from gsx.core.run_folder.run_key import NAMES, WHERE
from gsx.core.training.run import TrainingOptions


@dataclass(frozen=True, kw_only=True)
class Inner:
    strength: float
    cache_gb: float = without_effect()


@dataclass(frozen=True, kw_only=True)
class Outer:
    name: str
    title: str = label()
    folder: str = without_effect(default="here")
    inner: Inner
    other: Inner | None = None


def test_fields_inside_count_too() -> None:
    assert fields_with("none", Outer) == {"folder", "cache_gb"}
    assert fields_with("label", Outer) == {"title"}
    assert Outer(name="a", title="b", inner=Inner(strength=1.0, cache_gb=2.0)).folder == "here"


def test_keys_that_change_no_training_are_those_that_are_written_down() -> None:
    """As they stood in one list before every field said it of itself."""
    assert sorted(WHERE) == sorted(
        ("folder", "output", "device", "data_root", "tracker", "reuse", "init", "trunk_gb", "trunk_at")
    )
    assert sorted(NAMES) == sorted(("variant", "length", "budget", "dataset"))
    scene, diffusion = (
        plugins().registry.find(*key).options for key in (("scene", "photos"), ("regenerator", "sd_by_scale"))
    )
    assert idle_keys(scene, [diffusion], TrainingOptions) == IdleKeys(
        scene=frozenset({"path", "iterations", "cache_gb"}),
        regenerator=frozenset({"cache_gb", "download", "offload", "batch_pixels", "slicing"}),
        training=frozenset({"log_every", "checkpoint_every", "checkpoints_kept", "test_points"}),
    )
