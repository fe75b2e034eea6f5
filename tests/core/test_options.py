"""Options that say themselves whether they have an effect."""

from dataclasses import dataclass

from gsx.builtin import plugins
from gsx.core.options import fields_with, label, without_effect
from gsx.experiments.run_folder.run_key import NAMES, WHERE, without
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.settings import idle_keys


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


@dataclass(frozen=True, kw_only=True)
class Idle:
    steps: int = without_effect(default=3)


@dataclass(frozen=True, kw_only=True)
class Placed:
    path: str = without_effect(default="")


def test_fields_inside_count_too() -> None:
    assert fields_with("none", Outer) == {"folder", "inner.cache_gb", "other.cache_gb"}
    assert fields_with("label", Outer) == {"title"}
    assert Outer(name="a", title="b", inner=Inner(strength=1.0, cache_gb=2.0)).folder == "here"


def test_keys_that_change_no_training_are_those_that_are_written_down() -> None:
    """As they stood in one list before every field said it of itself."""
    viewer = ("viewer", "viewer_host", "viewer_port", "viewer_share", "minutes", "seconds")  # newer than that list
    assert sorted(WHERE) == sorted(
        (
            "folder",
            "output",
            "device",
            "data_root",
            "tracker",
            "reuse",
            "init",
            "axes",
            "disk_cache_gb",
            "warm_start_at",
            *viewer,
        )
    )
    assert sorted(NAMES) == sorted(("variant", "length", "budget", "dataset"))
    settings = compose(
        ["scene=photos", "regenerator/upscale=sd_by_scale", "regenerator/restore=scene_restorer"], plugins()
    )
    own = {f"training.{name}" for name in ("log_every", "checkpoint_every", "checkpoints_kept", "test_points")}
    own |= {f"scene.{name}" for name in ("path", "iterations", "cache_gb", "missing")}
    for model in ("x2", "x4"):
        for name in ("cached", "download", "offload", "batch_pixels", "slicing"):
            own.add(f"regenerator.upscale.{model}.{name}")
    assert settings.idle == own


def test_keys_are_left_out_where_they_are_meant_and_nowhere_else() -> None:
    """A plugin's `steps` without effect is not the `steps` of another regenerator."""
    config = {"scene": {"path": "/a", "inner": {"path": "b"}}, "regenerator": {"up": {"steps": 3}, "re": {"steps": 5}}}
    assert without(config, idle_keys({"regenerator.up": Idle, "scene": Placed})) == {
        "scene": {"inner": {"path": "b"}},
        "regenerator": {"up": {}, "re": {"steps": 5}},
    }
