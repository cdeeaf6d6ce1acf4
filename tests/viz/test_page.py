"""The page of a dream: everything is in the file, in its place, and a browser shows it."""

import base64
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from muvo_jax import config as config_lib
from muvo_jax.viz import page, sheets

GRID = config_lib.VoxelGrid(shape=(16, 12, 8), voxel_size_m=1.0, origin_m=(-8.0, -6.0, -1.0))
SCENE = sheets.Scene(grid=GRID, frame_s=0.2)
FRAMES, CONTEXT = 3, 2


def view(brightness):
    range_view = np.full((8, 32, 4), 10.0, np.float32)
    return sheets.View(image=np.full((32, 64, 3), brightness, np.uint8), range_view=range_view,
                       occupancy=np.zeros(GRID.shape, np.uint8))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A page with two futures, darker by the frame, and a baseline that has no voxels."""
    truth = [view(200)] * FRAMES
    futures = {f"future {index}": [view(40 * (frame + 1) + index) for frame in range(FRAMES)] for index in (1, 2)}
    beside = [{name: value for name, value in view(100).items() if name != "occupancy"}] * FRAMES
    return page.write_page(tmp_path_factory.mktemp("page") / "new" / "dream.html", truth, futures,
                           np.array([[0.5, -0.25], [-1.0, 0.0], [0.0, 1.0]]), SCENE, context=CONTEXT,
                           title="a </script> title", beside={"warp-last": beside})


def contents(path):
    text = path.read_text(encoding="utf-8")
    start = text.index("const page = ") + len("const page = ")
    return text, json.JSONDecoder().raw_decode(text[start:])[0]


def mean_brightness(address):
    kind, _, packed = address.partition(";base64,")
    assert kind == "data:image/webp"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(packed)))).mean()


def test_every_picture_lies_where_the_sliders_look_for_it(written):
    _, found = contents(written)
    assert (found["columns"], found["futures"]) == (["truth", "world model", "warp-last"], ["future 1", "future 2"])
    assert [picture["name"] for picture in found["pictures"]][:2] == ["image", "range"]
    assert [frame["time_s"] for frame in found["frames"]] == [-0.2, 0.0, 0.2] and found["context"] == CONTEXT
    assert found["frames"][0]["action"] == [0.5, -0.25]
    assert [len(branches) for branches in found["drawn"]] == [1, 2, 1]
    for branch in range(2):
        for frame in range(FRAMES):
            drawn = found["drawn"][1][branch][frame]
            assert mean_brightness(drawn[0]) == pytest.approx(40 * (frame + 1) + branch + 1, abs=2)
    voxels = next(index for index, picture in enumerate(found["pictures"]) if picture["name"] == "voxels above")
    assert found["drawn"][2][0][0][voxels] is None and found["drawn"][0][0][0][voxels]


def test_nothing_is_fetched_and_no_title_ends_the_script(written):
    text, found = contents(written)
    assert found["title"] == "a </script> title"
    assert text.count("</script>") == 1 and "http" not in text and "<link" not in text


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_browser_shows_the_first_imagined_frame_and_follows_the_keys(written):
    shown = browsed(written)
    assert "a &lt;/script&gt; title" in shown and ">imagined</span>" in shown and "+0.2 s" in shown
    assert shown.count('<img class="sensor"') == 6  # image and range of three columns
    found, pressed = contents(written)[1], written.with_name("pressed.html")
    keys = "".join(f"document.onkeydown(new KeyboardEvent('keydown', {{key: '{key}'}}));"
                   for key in ("ArrowLeft", "ArrowDown", "ArrowDown"))
    pressed.write_text(written.read_text(encoding="utf-8").replace("</body>", f"<script>{keys}</script></body>"),
                       encoding="utf-8")
    shown = browsed(pressed)
    assert ">observed</span>" in shown and "+0.0 s" in shown and "future 2" in shown
    pictures = re.findall('<img class="sensor"[^>]* src="([^"]*)"', shown)
    assert pictures[1] == found["drawn"][1][1][1][0]  # the second column's image: future 2, the last observed frame


def browsed(path):
    """The page as it stands in a browser, after its scripts."""
    return subprocess.run(["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", path.as_uri()],
                          capture_output=True, text=True, timeout=120, check=True).stdout
