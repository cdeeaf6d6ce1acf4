"""Agents that others wrote learn or plan in imagination, each through its door; the scripts of experiments/agents."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

SCRIPTS = pathlib.Path(__file__).parents[2] / "experiments" / "agents"


def output(name, library, *arguments):
    """What a script prints."""
    pytest.importorskip(library, reason=f"{library} is not installed")
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, SCRIPTS / f"{name}.py", *arguments], env=environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=SCRIPTS.parents[1])
    print(done.stdout)
    assert done.returncode == 0, done.stdout
    return done.stdout


def returns(name, library, *arguments):
    """Runs a script on the world of untrained weights; the numbers after the word "return" that it prints, in order."""
    lines = [line for line in output(name, library, *arguments).splitlines() if " return " in f" {line} "]
    return [float(number) for line in lines for number in re.findall(r"-?\d+\.\d{3}", line)]


@pytest.mark.slow
@pytest.mark.parametrize("name, library, steps", [
    ("brax_ppo", "brax", 20_000), ("gymnax_ppo", "gymnax", 50_000),
    ("stable_baselines3_ppo", "stable_baselines3", 8192)])
def test_ppo_learns_in_imagination(name, library, steps):
    seen = returns(name, library, f"--steps={steps}")
    assert len(seen) >= 2 and seen[-1] > 1.2 * seen[0]


@pytest.mark.slow
def test_gumbel_muzero_plans_better_than_chance():
    search, coasting, random = returns("mctx_gumbel_muzero", "mctx")
    assert search > coasting and search > random


@pytest.mark.slow
@pytest.mark.parametrize("name, library", [("brax_ppo", "brax"), ("gymnax_ppo", "gymnax")])
def test_ppo_learns_to_drive_in_the_model_that_ships_and_drives_the_town(name, library):
    text = output(name, library, "--run=builtin:town", "--rounds=1", "--steps=50000", "--drives=1")
    earned = [float(number) for number in re.findall(r"a step of imagination earns (-?\d+\.\d+)", text)]
    assert len(earned) == 2 and earned[1] > earned[0] + 0.2
    assert "1 drives in the town: success" in text
