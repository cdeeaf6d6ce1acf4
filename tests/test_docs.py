"""The Python code of README and docs runs as it stands there, on a run of fresh weights and a tiny town."""

import pathlib
import re

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
    assert names["transition"].reward.shape == () and names["transitions"].reward.shape == (15,)
    assert all(np.isfinite(value).all() for value in (names["transition"].reward, names["transitions"].reward,
                                                      names["metrics"]["actor_loss"]))
