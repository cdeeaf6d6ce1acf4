"""The packs of reference numbers in tests/golden and the rule that draws their inputs, for the tests that use a few."""

import pathlib

from muvo_jax.interop import packs
from muvo_jax.interop.weights_rule import make_input

__all__ = ["FOLDER", "Golden", "make_input"]
FOLDER = pathlib.Path(__file__).parent / "golden"


def Golden(file):
    return packs.Pack(FOLDER / file)
