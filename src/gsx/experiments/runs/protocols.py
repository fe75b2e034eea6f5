"""Named protocols, conf/protocol: how a paper or program prepares scenes and measures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsx.core.errors import ConfigError
from gsx.core.options import flattened
from gsx.experiments.runs.overrides import key_of, parse_overrides

GROUP = "protocol"
"""Group of named protocols on the command line."""
WITH_POSES = ("bungee", "colmap", "photos", "transforms")
"""Scenes of photos with poses: a protocol for one of them fits the others."""
OF_TRUTH = ("scene.resize_filter", "scene.resize_light")
"""Keys of a scene that change the truth of a picture and not its size."""
REMEDY = "choose a protocol that only measures, such as protocol=inria"


@dataclass(frozen=True, kw_only=True)
class NamedProtocol:
    """A file of conf/protocol, with the files that it builds on."""

    name: str
    scene: str
    """Scene that it is for; empty: any."""
    values: dict[str, Any]
    """Values by dotted key."""

    @property
    def measuring(self) -> dict[str, Any]:
        """Returns the values that fit any pictures: of `eval` and `metrics`, and the truth's filter."""
        return {k: v for k, v in self.values.items() if k.startswith(("eval.", "metrics.")) or k in OF_TRUTH}

    @property
    def preparing(self) -> dict[str, Any]:
        """Returns the other values: sizes, folders and splits of a scene."""
        return {key: value for key, value in self.values.items() if key not in self.measuring}

    def refuse(self, scene: str) -> None:
        """Raises ConfigError if it is for other scenes; one for a folder of a release fits no other."""
        alike = {self.scene, scene} <= {*WITH_POSES} and "scene.images" not in self.values
        if self.scene not in ("", scene) and not alike:
            raise ConfigError(f"protocol={self.name} is for scene={self.scene}, not for scene={scene}: {REMEDY}")

    def refuse_run(self, config: DictConfig, place: str) -> None:
        """Raises ConfigError if a run was prepared by other values; `place`: its folder."""
        self.refuse(str(OmegaConf.select(config, "scene.name")))
        for key, value in self.preparing.items():
            if (trained := OmegaConf.select(config, key)) != value:
                raise ConfigError(
                    f"protocol={self.name} sets {key}={value}, but {place} was trained with {trained}: train anew with "
                    f"that protocol, or {REMEDY}"
                )


def named_protocol(name: str) -> NamedProtocol:
    """Reads a protocol of gsx or of a plugin, inside a session of Hydra."""
    from hydra.core.global_hydra import GlobalHydra

    place = f"{GROUP}/{name}"
    sources = GlobalHydra.instance().config_loader().get_sources()
    config = next(source.load_config(place).config for source in sources if source.is_config(place))
    content: dict[str, Any] = dict(OmegaConf.to_container(config, resolve=False))  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    scene = ""
    for entry in content.pop("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            base = named_protocol(entry)
            values, scene = values | base.values, base.scene or scene
        elif isinstance(entry, dict):
            scene = str(entry.get("override /scene", scene))
    return NamedProtocol(name=name, scene=scene, values=values | flattened(content))


def refuse_other_scene(overrides: Sequence[str], config: DictConfig) -> None:
    """Raises ConfigError if overrides choose a protocol that does not fit the scene of their composition."""
    for override in parse_overrides([word for word in overrides if key_of(word) == GROUP]):
        if override.key_or_group == GROUP:
            named_protocol(str(override.value())).refuse(str(OmegaConf.select(config, "scene.name")))
