"""A storm of kills: takes of 20 frames whose workers, machines and drivers are killed at random, whatever they are at.

    python benchmarks/kills.py [--quick] [--kills N] [--seed N] --out result.json

- ``processes``: a driver with three processes; one of the four is killed, again and again.
- ``cluster``: a driver and a Ray cluster of three pretended machines of one core. Killed are the raylet of a machine,
  which another one replaces; an actor's process; or the driver.

Steps are those of tests of the plan: they nap, and write digests of what they read. A driver that was killed is started
again in the same folder until it ends well; then the folder must hold every output, with the bytes of a job in one
process that nobody disturbed, and nothing half written. ``executions`` over ``steps`` is what the kills cost.
"""

from __future__ import annotations

import argparse
import functools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import parts
import psutil
import record

sys.path.insert(0, str(record.ROOT / "tests"))
from support.toy_work import ToyWork, toy_plan

from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import no_progress
from beam_warp.plan.carry import carry_out
from beam_warp.plan.workers import InProcess

Row = dict[str, Any]

DRIVER = """
import sys
from pathlib import Path
from support.toy_work import toy_plan
from beam_warp.jobs.listeners import no_progress
from beam_warp.plan.carry import carry_out
from beam_warp.plan.crew import crew_of
if __name__ == "__main__":
    plan = toy_plan(Path(sys.argv[1]), seconds=float(sys.argv[3]))
    carry_out(plan, crew_of(sys.argv[2], None)(plan, "", no_progress))
"""

MACHINES = 3

PATHS = os.pathsep.join(filter(None, [str(record.ROOT / "tests"), os.environ.get("PYTHONPATH")]))
"""Where drivers and workers find the steps."""


@dataclass
class Bench:
    """How many are killed, and how long a step naps [s]."""

    kills: int
    seed: int
    nap: float

    def say(self, words: str) -> None:
        """Print a line."""
        print(words, flush=True)


def outputs(folder: Path) -> dict[str, bytes]:
    """Return every output of a take."""
    return {path.name: path.read_bytes() for path in (folder / "out").iterdir()}


def storm(bench: Bench, workers: str, kill: Callable[[random.Random, int], str]) -> Iterator[Row]:
    """Carry takes out until so many were killed, and compare each with one that nobody disturbed."""
    rng, killed, takes, executions, steps = random.Random(bench.seed), dict[str, int](), 0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        script = place / "driver.py"
        script.write_text(DRIVER)
        whole = toy_plan(place / "whole")
        carry_out(whole, InProcess(whole.works, no_progress))
        while sum(killed.values()) < bench.kills:
            out, code = place / f"take {takes}", None
            out.mkdir()
            while code != 0:
                command = [sys.executable, "-P", str(script), str(out), workers, str(bench.nap)]
                driver = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": PATHS})
                seen = begun(out)
                while (code := driver.poll()) is None:
                    if (now := begun(out)) > seen:  # else nobody has begun anything that a kill could spoil
                        seen = now
                        time.sleep(rng.uniform(0.0, 2.0 * bench.nap))
                        with suppress(psutil.NoSuchProcess):
                            what = kill(rng, driver.pid)
                            killed[what] = killed.get(what, 0) + 1
                    time.sleep(0.005)
                if code not in (0, -signal.SIGKILL):
                    raise RuntimeError(f"the driver must end well or be killed, got exit code {code}")
            again = toy_plan(out)
            calls = begun(out)
            carry_out(again, InProcess(again.works, no_progress))
            lost = begun(out) - calls
            left = [path.name for path in out.rglob(".*")]
            if outputs(out) != outputs(place / "whole") or lost or left:
                raise RuntimeError(f"take {takes} must be whole, got {lost} steps lost, left over: {left}")
            takes, executions, steps = takes + 1, executions + calls, steps + len(again.steps)
            bench.say(f"{takes} takes, killed {killed}")
            yield {
                "takes": takes,
                "killed": dict(killed),
                "kills": sum(killed.values()),
                "executions": executions,
                "steps": steps,
            }


def begun(folder: Path) -> int:
    """Return how often a step was begun in a folder."""
    return len(ToyWork(folder).calls()) if (folder / "calls.txt").exists() else 0


def processes(bench: Bench) -> Iterator[Row]:
    """Kill a driver, or twice as likely one of its three processes."""

    def kill(rng: random.Random, driver: int) -> str:
        children = [it for it in psutil.Process(driver).children() if "spawn_main" in str(it.cmdline())]
        chosen = rng.choice([psutil.Process(driver), *children, *children])
        chosen.kill()
        return "driver" if chosen.pid == driver else "worker"

    yield from storm(bench, "3", kill)


def cluster(bench: Bench) -> Iterator[Row]:
    """Kill machines of a Ray cluster, actors on them, or the driver."""
    from ray.cluster_utils import Cluster

    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": PATHS}
    os.chdir(tempfile.gettempdir())  # Ray's processes import from here first
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    os.environ["RAY_ADDRESS"] = found.address
    try:
        machines = [_machine(found) for _ in range(MACHINES)]

        def kill(rng: random.Random, driver: int) -> str:
            what = rng.choice(["driver", "raylet", "worker", "worker"])
            actors = [
                it for it in psutil.process_iter() if "_Actor" in it.name() or "_Actor" in "".join(it.cmdline()[:1])
            ]
            if what == "worker" and actors:
                rng.choice(actors).kill()
                return what
            if what == "raylet":
                machine = machines.pop(rng.randrange(len(machines)))
                found.remove_node(machine, allow_graceful=False)
                machines.append(_machine(found))
                return what
            psutil.Process(driver).kill()
            return "driver"

        yield from storm(bench, "ray", kill)
    finally:
        found.shutdown()


def _machine(cluster: Any, tries: int = 5) -> Any:
    """Let a machine of one core join; a raylet takes its time where others have the cores."""
    for _ in range(tries - 1):
        with suppress(Exception):
            return cluster.add_node(num_cpus=1)
    return cluster.add_node(num_cpus=1)


PARTS = {"processes": processes, "cluster": cluster}


def main() -> None:
    """Kill, and write the result after every take."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="four kills, to see whether it runs")
    parser.add_argument("--kills", type=int, default=100, help="at least, in each part")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=())
    record.add_arguments(parser)
    arguments = parser.parse_args()
    bench = Bench(4 if arguments.quick else arguments.kills, arguments.seed, 0.1)
    keep = functools.partial(record.write_result, arguments, resolve_device("cpu"))
    parts.measure(PARTS, bench, only=arguments.parts, keep=keep)


if __name__ == "__main__":
    main()
