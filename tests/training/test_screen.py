"""What is said of other libraries' errors."""

import pytest

from muvo_jax.training import screen


@pytest.mark.parametrize("text, said", [
    ("Failed to write: No space left on device\n  in file 3", "OSError: Failed to write: No space left on device"),
    ("\n  first\nsecond", "OSError: first"),
    ("", "OSError: no details"),
])
def test_an_error_is_said_by_its_kind_and_first_line(text, said):
    assert screen.said(OSError(text)) == said


def test_of_a_long_error_the_cause_which_stands_last_is_kept():
    error = ValueError(f"OUT_OF_RANGE: Error writing \"{'/a/deep/folder' * 100}\": File too large [os_error_code='27']")
    said = screen.said(error)
    assert said.startswith('ValueError: OUT_OF_RANGE: Error writing "/a/deep') and " ... " in said
    assert said.endswith("File too large [os_error_code='27']")
    assert len(said) < 650
