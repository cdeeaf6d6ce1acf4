"""Drawing primitives: sizes, places and colours by arithmetic, files that others can open."""

import numpy as np
import pytest
from PIL import Image

from muvo_jax.viz import canvas

RED, BLUE = (255, 0, 0), (0, 0, 255)


def test_pictures_are_put_below_and_beside_each_other_from_the_top_left():
    wide, tall = canvas.blank(2, 5, RED), canvas.blank(4, 3, BLUE)
    below = canvas.stack([wide, tall], axis=0, gap=1)
    assert below.shape == (2 + 1 + 4, 5, 3)
    np.testing.assert_array_equal(below[:2], wide)
    np.testing.assert_array_equal(below[3:, :3], tall)
    assert (below[2] == canvas.BACKGROUND).all() and (below[3:, 3:] == canvas.BACKGROUND).all()
    beside = canvas.stack([wide, tall], axis=1, gap=2)
    assert beside.shape == (4, 5 + 2 + 3, 3)
    np.testing.assert_array_equal(beside[:, 7:], tall)
    assert (beside[2:, :5] == canvas.BACKGROUND).all()
    np.testing.assert_array_equal(canvas.stack([tall], axis=1), tall)


@pytest.mark.parametrize(("size", "columns", "expected"), [
    ((4, 6), 6, (4, 6)), ((4, 6), 18, (12, 18)), ((4, 6), 9, (6, 9)), ((40, 60), 6, (4, 6)), ((2, 400), 20, (1, 20))])
def test_resizing_keeps_the_shape_of_what_is_shown(size, columns, expected):
    picture = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    assert canvas.resize(picture, columns).shape == canvas.resize_hard(picture, columns).shape == (*expected, 3)
    if columns % size[1] == 0:  # every pixel a block of its own
        factor = columns // size[1]
        np.testing.assert_array_equal(canvas.resize(picture, columns)[::factor, ::factor], picture)
        np.testing.assert_array_equal(canvas.resize(picture, columns)[factor - 1::factor, factor - 1::factor], picture)


def test_resize_hard_keeps_only_colours_that_were_there():
    picture = np.zeros((3, 5, 3), np.uint8)
    picture[1, 2] = (10, 20, 30)
    large = canvas.resize_hard(picture, 13)
    assert large.shape == (8, 13, 3)
    assert {tuple(pixel) for pixel in large.reshape(-1, 3).tolist()} == {(0, 0, 0), (10, 20, 30)}


def test_a_border_and_a_caption_leave_the_picture_as_it_is():
    picture = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    framed = canvas.frame(picture, RED, 2)
    assert framed.shape == (24, 34, 3) and (framed[:2] == RED).all() and (framed[:, -2:] == RED).all()
    np.testing.assert_array_equal(framed[2:-2, 2:-2], picture)
    for text in ("a", "a caption that is wider than the picture"):
        below = canvas.caption(picture, text)
        assert below.shape[1] >= canvas.text_width_px(text)
        np.testing.assert_array_equal(below[-20:, :30], picture)
        assert (below[:-20] == canvas.INK).all(axis=-1).any()


def test_names_of_any_script_are_drawn_in_letters_that_the_font_has():
    blank = canvas.blank(20, 200)
    drawn = [canvas.write(blank, text, 2, 2) for text in ("Zürich, été", "Zurich, ete", "東京", "??")]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    np.testing.assert_array_equal(drawn[2], drawn[3])
    assert canvas.text_width_px("Zürich") == canvas.text_width_px("Zurich")


def test_classes_look_unlike_and_what_is_unlabelled_is_black():
    table = canvas.class_colours(20).astype(int)
    assert table.shape == (256, 3) and not table[20:].any()
    apart = np.abs(table[:20, None] - table[None, :20]).sum(-1)
    assert apart[~np.eye(20, dtype=bool)].min() > 20
    assert np.diagonal(apart, offset=1).min() > 100  # neighbours


def test_a_colour_bar_runs_from_its_first_colour_to_its_last():
    bar = canvas.colour_bar(canvas.RANGE_COLOURS, "near", "far", "range", columns=50)
    row = [tuple(colour) for colour in bar[5].tolist()]
    start = row.index(canvas.RANGE_COLOURS[0])
    assert row[start + 49] == canvas.RANGE_COLOURS[-1] and start > canvas.text_width_px("range")
    inked = (bar != canvas.BACKGROUND).any(axis=(0, 2))
    assert inked[:start].any() and inked[start + 50:].any()  # a label on either side


def test_files_are_whole_and_hold_what_was_drawn(tmp_path):
    pictures = [canvas.blank(8, 10, colour) for colour in (RED, BLUE, RED)]
    path = canvas.save_png(tmp_path / "new" / "still.png", pictures[0])
    np.testing.assert_array_equal(np.array(Image.open(path)), pictures[0])
    path = canvas.save_gif(tmp_path / "new" / "moving.gif", pictures, 0.2)
    with Image.open(path) as moving:
        assert (moving.n_frames, moving.info["duration"], moving.info["loop"]) == (3, 200, 0)
        for index, colour in enumerate((RED, BLUE, RED)):
            moving.seek(index)
            assert np.abs(np.array(moving.convert("RGB")).astype(int) - colour).max() < 8
    assert sorted(entry.name for entry in (tmp_path / "new").iterdir()) == ["moving.gif", "still.png"]
    with pytest.raises(ValueError, match="got no frames, expected at least one"):
        canvas.save_gif(tmp_path / "none.gif", [], 0.1)
