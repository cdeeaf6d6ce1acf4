"""The Python code of README, docs and examples runs as it stands there, on a run of fresh weights and a tiny town."""

import pathlib
import re
import runpy

import jax
import numpy as np
import pytest

from muvo_jax import presets
from muvo_jax.model import world_model
from muvo_jax.training import builtin, checkpoint

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with runs/town-tr, and the same model under builtin/town."""
    folder, config = tmp_path_factory.mktemp("docs"), presets.tiny()
    variables = world_model.WorldModel(config.model).init(jax.random.key(0))
    checkpoint.save_variables(folder / "runs" / "town-tr", 1, variables, config=config)
    builtin.seal(checkpoint.load_run(folder / "runs" / "town-tr"), folder / "builtin" / "town", {})
    return folder


@pytest.fixture(autouse=True)
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    monkeypatch.setattr(builtin, "FOLDER", folder / "builtin")


def run(page):
    """What the names of a page mean after all of its Python code has run."""
    names = {}
    for code in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(code, page, "exec"), names)
    return names


def test_readme(folder):
    names = run("README.md")
    town, = (folder / "cache" / "muvo_jax").glob("town-*")
    assert {path.name for path in town.iterdir() if path.is_dir()} == {"val_rl"}  # the rest would take minutes
    image = names["predictions"].image
    assert image.shape == (2, 1, 32, 64, 3) and np.isfinite(image).all()
    assert names["predictions"].at_scale(2).image.shape == (2, 1, 16, 32, 3)


def test_agents():
    names = run("docs/agents.md")
    assert names["transition"].reward.shape == () and names["transitions"].reward.shape == (6,)
    assert all(np.isfinite(value).all() for value in (names["transition"].reward, names["transitions"].reward,
                                                      names["metrics"]["actor_loss"]))


@pytest.mark.parametrize(("example", "arguments", "printed"), [
    ("imagine", (), r"states of 2 starts under 2 plans of 8 steps: \(2, 2, 8, "),
    ("branch_and_score", (), r"collision\n( *-?[\d.]+ +-?[\d.]+ +-?[\d.]+ +-?[\d.]+ +[\d.]+\n){9}"),
    ("plan", (), r"expected return -?[\d.]+;"),
    ("train_agent", ("learned", "2"), r"update 2: imagined return -?[\d.]+, .*\nwrote learned"),
    ("gradient", (), r"step 30: distance [\d.]+, .*\n(\w+: correlation .* driven -?[\d.]+\n){2}")],
    ids=lambda value: value if isinstance(value, str) and value.isidentifier() else "")
def test_an_example(example, arguments, printed, capsys):
    main = runpy.run_path(str(ROOT / "examples" / f"{example}.py"))["main"]
    main("runs/town-tr", *arguments)
    assert re.search(printed, capsys.readouterr().out)
