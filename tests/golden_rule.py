"""The files of reference numbers in tests/golden and the rule that draws their inputs, for the tests that use a few."""

import pathlib

from muvo_jax.interop.parity import golden
from muvo_jax.interop.weights_rule import make_input

__all__ = ["FOLDER", "Golden", "make_input"]
FOLDER = pathlib.Path(__file__).parent / "golden"


def Golden(file):
    return golden.File(FOLDER / file)
