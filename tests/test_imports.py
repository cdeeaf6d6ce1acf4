"""Who may import whom (docs/design.md): left may be imported by right, never the reverse."""

import ast
import pathlib
import subprocess
import sys

import pytest

import muvo_jax

PACKAGE = pathlib.Path(muvo_jax.__file__).parent
BASE = {"types", "config", "geometry", "limits", "ops", "head"}
ALLOWED = {
    "types": set(),
    "cache": set(),
    "limits": set(),
    "safetensors_file": set(),
    "geometry": {"limits"},
    "late": set(),
    "config": {"geometry", "limits"},
    "presets": {"config"},
    "ops": {"types", "config", "geometry"},
    "head": {"types", "config"},
    "nn": BASE,
    "model": BASE | {"nn"},
    "objectives": BASE | {"nn", "model"},
    "metrics": BASE | {"nn", "model"},
    "heads": BASE | {"nn", "model", "objectives", "metrics", "viz"},  # imported by none: found by name
    "run": {"types", "config", "model"},
    "agents": BASE | {"nn", "model", "metrics", "run", "safetensors_file"},
    "data": BASE,
    "town": BASE | {"data", "cache"},
    "recordings": {"config", "data", "town"},
    "viz": BASE,
    "interop": BASE | {"nn", "model", "objectives", "metrics", "data", "training", "command_line", "late",
                       "safetensors_file"},
    "training": BASE | {"nn", "model", "run", "objectives", "metrics", "data", "recordings",
                        "safetensors_file"},
}
# Inside data: what every format shares, the formats, what finds them, and what makes batches of any of them.
RECORDED = {"errors", "fields", "words", "schema", "sequences", "files", "pictures", "description", "runs",
            "ego_motion", "processes", "fingerprints"}
ALLOWED_IN_DATA = dict.fromkeys(RECORDED, RECORDED) | {
    "plain": RECORDED,
    "kitti": RECORDED,
    "nuscenes": RECORDED,
    "muvo": RECORDED | {"plain"},  # its exporter reads the plain format
    "carla": RECORDED | {"plain", "muvo"},
    "packed": RECORDED | {"sources"},  # its writer reads any format
    "sources": RECORDED | {"plain", "kitti", "nuscenes", "muvo", "packed"},
    "voxelizing": RECORDED | {"plain", "muvo"},
    "prepare": RECORDED,
    "windows": RECORDED | {"prepare"},
    "fitting": RECORDED | {"prepare", "windows"},
    "pipeline": RECORDED | {"prepare", "windows"},
    "checkup": RECORDED,
}


def modules_imported(path: pathlib.Path, package: str = "muvo_jax") -> set[str]:
    """The first-level parts of a package that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == package:
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package}."):
            found.add(node.module.removeprefix(f"{package}.").split(".")[0])
        elif isinstance(node, ast.Import):
            found |= {alias.name.removeprefix(f"{package}.").split(".")[0] for alias in node.names
                      if alias.name.startswith(f"{package}.")}
    return found


def parts(folder: pathlib.Path) -> set[str]:
    """The packages and modules of a folder."""
    return {path.stem for path in folder.iterdir() if (path / "__init__.py").exists() or path.suffix == ".py"}


def stray_imports(folder: pathlib.Path, part: str, allowed: set[str], package: str) -> list[str]:
    """What files of a part import that they may not."""
    files = sorted((folder / part).rglob("*.py")) if (folder / part).is_dir() else [folder / f"{part}.py"]
    assert files
    return [f"{path.relative_to(PACKAGE)} imports {stray}" for path in files
            if (stray := modules_imported(path, package) - allowed - {part})]


@pytest.mark.parametrize("layer", sorted(ALLOWED))
def test_layer_imports_only_what_lies_left_of_it(layer):
    assert not stray_imports(PACKAGE, layer, ALLOWED[layer], "muvo_jax")


@pytest.mark.parametrize("part", sorted(ALLOWED_IN_DATA))
def test_part_of_data_imports_only_what_it_may(part):
    assert not stray_imports(PACKAGE / "data", part, ALLOWED_IN_DATA[part], "muvo_jax.data")


def test_every_part_of_the_package_has_its_place():
    assert {part for part in parts(PACKAGE) if (PACKAGE / part).is_dir()} <= set(ALLOWED)
    assert parts(PACKAGE / "data") - {"__init__"} == set(ALLOWED_IN_DATA)


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
