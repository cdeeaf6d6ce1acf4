"""python -m muvo_jax.record_carla OUT: records the paper's drives from a running CARLA server."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated

import tyro

from muvo_jax import command_line, late

with late.imports():
    from muvo_jax.data import voxelizing, words
    from muvo_jax.data.carla import client as carla_client
    from muvo_jax.data.carla import drives as carla_drives
    from muvo_jax.data.carla import recorder as carla_recorder
    from muvo_jax.training import screen


@dataclasses.dataclass(frozen=True)
class Options:
    """Records camera, depth, classes, lidar and route map from a running CARLA server (extra [carla]) in the plain
    format. Complete runs that are there already are kept, the rest is recorded; docs/data.md says what is recorded and
    what has not been tried on a live server.
    """

    out: Annotated[pathlib.Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder of the recording."""
    estimate: bool = False
    """Print what disk and hours it takes, and stop; needs no server."""
    agent: Annotated[str | None, command_line.shown("MODULE:FUNCTION", "autopilot")] = None
    """The expert: function(vehicle, route) -> agent, agent(observed) -> carla.VehicleControl."""
    towns: tuple[str, ...] = carla_drives.TOWNS
    """Maps of the server."""
    train_runs: int = 25
    """Runs for training in each town."""
    val_runs: int = 5
    """Runs in each town for either validation split."""
    seconds: float = carla_drives.RUN_S
    """Length of a run."""
    seed: int = 0
    """Of weathers, routes and traffic."""
    occupancy: bool = False
    """Make the occupancy of all runs, too, at the end (as python -m muvo_jax.voxelize OUT does)."""
    vehicles: int = 80
    """Other cars."""
    walkers: int = 80
    """Pedestrians."""
    host: str = "127.0.0.1"
    """Where the server runs."""
    port: int = 2000
    """Its port."""
    traffic_port: int = 8000
    """Port for the traffic manager."""


EXAMPLES = """
python -m muvo_jax.record_carla recordings/carla --estimate
python -m muvo_jax.record_carla recordings/carla
python -m muvo_jax.record_carla recordings/small --towns Town01 --train-runs=2 --val-runs=1 --seconds=60
python -m muvo_jax.record_carla recordings/mine --agent=my_driver:make_agent
"""


def record(options: Options, show: screen.Screen) -> None:
    """Does what the command line asks for."""
    settings = carla_drives.Settings()
    jobs = carla_drives.plan(towns=options.towns, train_runs=options.train_runs, val_runs=options.val_runs,
                               run_s=options.seconds, seed=options.seed)
    needed = carla_drives.estimate(options.out, jobs, settings)
    show.line(str(needed))
    if options.estimate:
        return
    if needed.missing:
        _drive(options, show, settings, jobs)
    if options.occupancy:
        with show.counter("voxelizing", "frames") as progress:
            voxelizing.voxelize(options.out, progress=progress)
    show.line(f"complete in {options.out}: {words.counted(len(jobs), 'run')}.")


def _drive(options: Options, show: screen.Screen, settings: carla_drives.Settings,
           jobs: list[carla_drives.CarlaDrive]) -> None:
    make_agent = carla_client.load_agent(options.agent) if options.agent else None
    client = carla_client.Client(settings, host=options.host, port=options.port, traffic_port=options.traffic_port,
                                 vehicles=options.vehicles, walkers=options.walkers, make_agent=make_agent)
    with show.counter("recording", "frames") as progress:
        carla_recorder.record(options.out, client, jobs, settings, progress=progress)


def main() -> int:
    return command_line.run(Options, record, program="record_carla", examples=EXAMPLES)


if __name__ == "__main__":
    sys.exit(main())
