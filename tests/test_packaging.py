"""The wheel holds all that the package reads."""

import pathlib
import tomllib

import muvo_jax

PACKAGE = pathlib.Path(muvo_jax.__file__).parent


def test_every_data_file_of_the_package_is_shipped():
    settings = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    shipped = {path for package, patterns in settings["package-data"].items() for pattern in patterns
               for path in PACKAGE.parent.joinpath(*package.split(".")).glob(pattern)}
    files = {path for path in PACKAGE.rglob("*")
             if path.is_file() and path.suffix not in (".py", ".pyc") and "__pycache__" not in path.parts}
    assert files and files == shipped


def test_every_folder_with_code_is_a_package():
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert all((folder / "__init__.py").exists() for folder in folders)
