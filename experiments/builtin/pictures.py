"""Makes the pictures of README.md from a model that ships: python experiments/builtin/pictures.py [RUN]"""

import pathlib
import shutil
import sys
import tempfile

from muvo_jax import dream
from muvo_jax.training import screen

PICTURES = pathlib.Path(__file__).parents[2] / "docs" / "pictures"
MOMENTS = 4


def main(run: str = "builtin:town") -> None:
    with tempfile.TemporaryDirectory() as folder:
        written = dream.dream(dream.Options(pathlib.Path(run), moments=MOMENTS, out=pathlib.Path(folder)),
                              screen.Screen())
        for path in written:
            if path.suffix == ".png":
                shutil.copy(path, PICTURES / f"dream_{path.stem.rpartition('_')[2]}.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
