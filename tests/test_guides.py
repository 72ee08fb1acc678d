"""The guides for users of other tools and for tuning: the methods, settings, protocols and code that they name exist."""

import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
import torch

from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.metrics.conventions import PROTOCOLS
from invgraphics.recipes.aliases import ALIASES
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.recipes.settings import settings_of
from invgraphics.scenes.degrade import TrainingData

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = ("coming-from.md", "tuning.md")
SETTING = re.compile(r"(?:--set )?((?:field|renderer|losses|optimiser|hooks|batches|training|data)(?:\.\w+)+)(?: ?= ?(\S+))?")
KEYS = {name: {setting.key for setting in settings_of(load_method(name).recipe)} for name in methods()}
"""Every method -> its settings."""


def spans(guide: str) -> Iterator[str]:
    """Code spans of a guide's tables; one that begins with a dot continues the key before it in its cell."""
    for line in (DOCS / guide).read_text().splitlines():
        for cell in line.split("|") if line.startswith("|") else ():
            parent = ""
            for span in re.findall(r"`([^`]+)`", cell):
                whole = parent + span if re.match(r"\.\w+", span) else span
                if match := SETTING.fullmatch(whole):
                    parent = match[1].rpartition(".")[0]
                yield whole


def _takes(method: str, key: str, value: str) -> bool:
    try:
        load_method(method, overrides=[f"{key}={value}"])
    except InputError:
        return False
    return True


@pytest.mark.parametrize("guide", GUIDES)
def test_settings_exist_and_take_the_values(guide: str) -> None:
    of_data = {f"data.{field.name}" for field in fields(TrainingData)}
    named = [match.groups() for span in spans(guide) if (match := SETTING.fullmatch(span))]
    assert len(named) > 10
    for key, value in named:
        if key in of_data or key == "optimiser.groups.NAME.lr":
            continue
        having = [name for name, keys in KEYS.items() if key in keys]
        assert having, key
        assert value is None or any(_takes(name, key, value) for name in having), (key, value)


@pytest.mark.parametrize("guide", GUIDES)
def test_methods_exist(guide: str) -> None:
    text = (DOCS / guide).read_text()
    families = {name.partition("/")[0] for name in KEYS}
    named = {name for family in families for name in re.findall(rf"(?<![\w/]){family}/[a-z0-9-]+", text)}
    assert len(named) > 5 and named <= set(KEYS)


@pytest.mark.parametrize("guide", GUIDES)
def test_options_exist(guide: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Options of our commands, and those that stand alone in the column of what to change or type here."""
    commands = ("fit", "compare", "rescore", "export", "render", "explain", "import-photos")
    known = set()
    for command in commands:
        with pytest.raises(SystemExit):
            main.run([command, "--help"])
        known |= set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    rows = [line.split("|")[2:] for line in (DOCS / guide).read_text().splitlines() if line.startswith("|")]
    named = [span for row in rows for cell in row for span in re.findall(r"`([^`]+)`", cell)]
    ours = [span for span in named if re.match(r"--|invgraphics |rescore ", span)]
    options = {option for span in ours for option in re.findall(r"--[a-z-]+", span)}
    assert len(options) > 4
    assert options - known <= {"--pipeline"}  # nerfstudio's, in a table of conventions


def test_what_gsplat_calls_its_settings_has_these_values_in_ours() -> None:
    """Values that stand beside a key of splatting's growth are those of its preset."""
    told = dict(match.groups() for span in spans("coming-from.md") if (match := SETTING.fullmatch(span)) and match[2])
    values = {setting.key: setting.value for setting in settings_of(load_method("splatting/gaussians").recipe)}
    for key in ("renderer.dilation", "hooks.1.threshold", "losses.1.weight"):
        assert float(told[key]) == float(values[key])
    paper = {setting.key: setting.value for setting in settings_of(load_method("splatting/gaussians", preset="paper").recipe)}
    assert (values["hooks.1.revised_opacity"], paper["hooks.1.revised_opacity"]) == ("true", "false")
    assert values["hooks.1.resets"] == "[]"


def test_names_of_methods_and_protocols_of_other_tools() -> None:
    text = (DOCS / "coming-from.md").read_text()
    for name in ("splatfacto", "instant-ngp", "nerfacto"):
        assert name in ALIASES and f"`{name}`" in text
    assert "gsplat" in PROTOCOLS
    tools = {re.split("-metrics|-train|-nerf$|-splatfacto", name)[0] for name, protocol in PROTOCOLS.items() if protocol.source}
    assert len(tools) == 7, tools


def test_the_example_of_rasterization_renders_its_gaussian() -> None:
    """Seen head on, a Gaussian covers its middle pixel by its opacity; half a pixel off, by what its footprint says."""
    (code,) = re.findall(r"^```python\n(.*?)^```", (DOCS / "coming-from.md").read_text(), flags=re.S | re.M)
    names: dict = {}
    exec(code, names)
    picture = names["picture"]
    variance = (100.0 * 0.2 / 3.0) ** 2 + 0.3
    expected = 0.9 * torch.exp(torch.tensor(-0.5 * 2 * 0.5**2 / variance))
    assert picture.rgb.shape == (64, 64, 3)
    torch.testing.assert_close(picture.alpha[32, 32], expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(picture.rgb[32, 32], expected * torch.tensor([1.0, 0.5, 0.0]), rtol=1e-4, atol=1e-5)
