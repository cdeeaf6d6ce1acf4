"""Where real and reference recordings lie, for tests that skip without them."""

import os
import pathlib


def find(variable: str, *names: str) -> pathlib.Path | None:
    """The folder that an environment variable names, or the first of `names` below a folder beside the repository."""
    beside = pathlib.Path(__file__).parents[3]
    candidates = [os.environ.get(variable), *(path for name in names for path in sorted(beside.glob(f"*/{name}")))]
    return next((pathlib.Path(path) for path in candidates if path and pathlib.Path(path).is_dir()), None)


MUVO_LAYOUT = find("MUVO_LAYOUT", "data/muvo_layout")
KITTI = find("MUVO_KITTI", "data/kitti_raw")
GOLDEN = find("MUVO_GOLDEN", "golden")
