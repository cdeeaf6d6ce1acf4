"""The train_agent command: what it says of imagined drives, what it refuses and its picture."""

import jax.numpy as jnp
import pytest

from muvo_jax import command_line, train_agent
from muvo_jax.agents import futures as futures_lib
from muvo_jax.training import screen


def test_help_shows_examples_and_explains_every_option(capsys):
    with pytest.raises(SystemExit) as ended:
        command_line.run(train_agent.Options, lambda *_: None, program="train_agent", arguments=["--help"],
                         examples=train_agent.EXAMPLES)
    text = capsys.readouterr().out
    assert ended.value.code == 0 and text.count("python -m muvo_jax.train_agent ") >= 2 and "None" not in text


def test_imagined_drives_count_until_they_end():
    """The first ends after its second step; what follows there is not counted: (1 - 3 + 1 + 1 + 1) / 5."""
    reward = jnp.array([[1.0, -3.0, 9.0], [1.0, 1.0, 1.0]])
    ended = jnp.array([[False, True, False], [False, False, False]])
    futures = futures_lib.Futures(None, None, None, None, jnp.ones(2), reward, 2.0 * reward, ended)
    scores = train_agent.imagined_scores(futures)
    assert scores["imagined_reward"] == pytest.approx(0.2) and scores["imagined_progress_m"] == pytest.approx(0.4)
    assert scores["imagined_ends"] == 0.5


def test_the_picture_needs_no_judge(tmp_path):
    row = {"updates": 60, "imagined_reward": 0.5, "imagined_progress_m": 1.0, "imagined_ends": 0.1}
    train_agent.draw(tmp_path / "a.png", [row])
    train_agent.draw(tmp_path / "b.png", [row, {**row, "updates": 120, "town_reward": 0.4, "town_progress_m": 1.2,
                                                "town_success": 1.0}])
    assert (tmp_path / "a.png").stat().st_size > 0 and (tmp_path / "b.png").stat().st_size > 0


def test_a_round_of_nothing_is_refused():
    with pytest.raises(ValueError, match="--futures is 0; it must be at least 1"):
        train_agent.train_agent(train_agent.Options("r", futures=0), screen.Screen())
