"""Who may import whom (docs/design.md): left may be imported by right, never the reverse."""

import ast
import pathlib
import subprocess
import sys

import pytest

import muvo_jax

PACKAGE = pathlib.Path(muvo_jax.__file__).parent
BASE = {"types", "config", "geometry", "limits", "ops"}
ALLOWED = {
    "types": set(),
    "limits": set(),
    "geometry": {"limits"},
    "late": set(),
    "config": {"geometry", "limits"},
    "presets": {"config"},
    "ops": {"types", "config", "geometry"},
    "nn": BASE,
    "model": BASE | {"nn"},
    "objectives": BASE | {"nn", "model"},
    "metrics": BASE | {"nn", "model"},
    "run": {"types", "config", "model"},
    "agents": BASE | {"nn", "model", "metrics", "run"},
    "data": BASE,
    "viz": BASE,
    "interop": BASE | {"nn", "model", "objectives", "metrics", "data", "training", "command_line", "late"},
    "training": BASE | {"nn", "model", "run", "objectives", "metrics", "data"},
}


def modules_imported(path: pathlib.Path) -> set[str]:
    """The first-level muvo_jax parts that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "muvo_jax":
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("muvo_jax.")}
    return found


@pytest.mark.parametrize("layer", sorted(ALLOWED))
def test_layer_imports_only_what_lies_left_of_it(layer):
    folder = PACKAGE / layer
    files = sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{layer}.py"]
    assert files
    for path in files:
        stray = modules_imported(path) - ALLOWED[layer] - {layer}
        assert not stray, f"{path.relative_to(PACKAGE)} imports {stray}"


def test_every_part_of_the_package_has_its_place():
    parts = {path.stem for path in PACKAGE.iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    assert parts <= set(ALLOWED)


def test_importing_the_library_loads_no_checkpoint_data_or_plotting_code():
    program = ("import sys, muvo_jax; [getattr(muvo_jax, name) for name in muvo_jax.__all__]; "
               "print([m for m in ('orbax', 'grain', 'tensorboardX', 'PIL', 'tyro') if m in sys.modules])")
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "[]"


def test_public_names_are_these():
    assert sorted(muvo_jax.__all__) == [
        "Batch", "Config", "Dream", "Environment", "LatentState", "LiveState", "ModelConfig", "Observed",
        "Predictions", "Run", "WorldModel", "decode", "imagine", "imagine_step", "load", "observe", "observe_step",
        "presets", "start_live", "windows",
    ]
    assert all(getattr(muvo_jax, name) is not None for name in muvo_jax.__all__)
