"""Named protocols, conf/protocol: how a paper or program prepares scenes and measures."""

from collections.abc import Iterator, Sequence
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

    def fits(self, scene: str) -> bool:
        """Returns whether it is for a scene of that name; one for a folder of a release fits no other."""
        alike = {self.scene, scene} <= {*WITH_POSES} and "scene.images" not in self.values
        return self.scene in ("", scene) or alike

    @property
    def measuring(self) -> dict[str, Any]:
        """Returns the values that fit any pictures: of `eval` and `metrics`, and the truth's filter."""
        return {k: v for k, v in self.values.items() if k.startswith(("eval.", "metrics.")) or k in OF_TRUTH}

    @property
    def preparing(self) -> dict[str, Any]:
        """Returns the other values: sizes, folders and splits of a scene."""
        return {key: value for key, value in self.values.items() if key not in self.measuring}

    def refuse(self, scene: str) -> None:
        """Raises ConfigError if it does not fit a scene."""
        if not self.fits(scene):
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
    """Reads a protocol, inside a session of Hydra."""
    content = content_of(name)
    values: dict[str, Any] = {}
    scene = ""
    for entry in content.pop("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            base = named_protocol(entry)
            values, scene = values | base.values, base.scene or scene
        elif isinstance(entry, dict):
            scene = str(entry.get("override /scene", scene))
    return NamedProtocol(name=name, scene=scene, values=values | flattened(content))


def content_of(name: str) -> dict[str, Any]:
    """Returns the content of a protocol's file, of gsx or of a plugin."""
    from hydra.core.global_hydra import GlobalHydra

    place = f"{GROUP}/{name}"
    sources = GlobalHydra.instance().config_loader().get_sources()
    config = next(source.load_config(place).config for source in sources if source.is_config(place))
    return dict(OmegaConf.to_container(config, resolve=False))  # type: ignore[arg-type]


def chosen_protocols(overrides: Sequence[str]) -> Iterator[NamedProtocol]:
    """Yields the protocols that overrides choose."""
    for override in parse_overrides([word for word in overrides if key_of(word) == GROUP]):
        if override.key_or_group == GROUP:
            yield named_protocol(str(override.value()))


def refuse_other_scene(overrides: Sequence[str], config: DictConfig) -> None:
    """Raises ConfigError if overrides choose a protocol that does not fit the scene of their composition."""
    for protocol in chosen_protocols(overrides):
        protocol.refuse(str(OmegaConf.select(config, "scene.name")))
