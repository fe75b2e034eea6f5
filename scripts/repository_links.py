"""Hook of mkdocs: pages link to their source where the environment variable GSX_REPOSITORY names the repository."""

from mkdocs.config.defaults import MkDocsConfig


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Set the address of edit links; without a repository there are none."""
    if config.repo_url:
        config.edit_uri = "edit/main/docs/"
    return config
