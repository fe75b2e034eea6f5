"""The pages of the site that scripts make: every public name, hook and verb is on them; links lead to results."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
from pages import ROOT

import gsx
from gsx.cli.dispatch import VERBS
from gsx.core.plugins import Hooks

SCRIPTS = ROOT / "scripts"


@pytest.fixture(scope="module")
def site() -> ModuleType:
    """Return scripts/site.py as a module; Python has another of that name."""
    pytest.importorskip("mkdocs")
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("gsx_site", SCRIPTS / "site.py")
        assert spec
        assert spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


def test_the_api_page_has_every_public_name_and_hook(site: ModuleType) -> None:
    page = site.api_page()
    for name in gsx.OFFERED:
        assert f"\n#### {name}\n" in page, name
    for name in (name for name in vars(Hooks) if name.startswith("gsx_")):
        assert f"def {name}(" in page, name


def test_the_page_of_the_command_line_has_every_verb(site: ModuleType) -> None:
    page = site.cli_page()
    for verb in VERBS:
        assert f"## gsx {verb}\n\n```text\nusage: gsx {verb}" in page, verb


@pytest.mark.parametrize(
    ("link", "rewritten"),
    [
        ("[a](../../benchmarks/results/zoom_cpu.md)", "[a](../benchmarks/zoom_cpu.md)"),
        ("[a](../../benchmarks/results/epyc/step_cpu.md#b)", "[a](../benchmarks/epyc/step_cpu.md#b)"),
        ("[a package](../../examples/plugin)", "a package (`examples/plugin`)"),
        ("[`conf/`](../../conf/config.yaml)", "`conf/config.yaml`"),
        ("[a](../reference/formats.md)", "[a](../reference/formats.md)"),
    ],
)
def test_links_out_of_docs_lead_to_results_or_become_words(site: ModuleType, link: str, rewritten: str) -> None:
    class Page:
        class file:
            src_uri = "how-to/choose-settings.md"

    assert site.on_page_markdown(link, Page) == rewritten


def test_links_to_nothing_are_errors(site: ModuleType) -> None:
    class Page:
        class file:
            src_uri = str(Path("how-to") / "install.md")

    with pytest.raises(ValueError, match="is no file"):
        site.on_page_markdown("[a](../../nothing.md)", Page)
