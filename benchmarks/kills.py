"""A storm of kills: takes of 20 frames whose workers, machines and drivers are killed at random, whatever they are at.

    python benchmarks/kills.py [--quick] [--steps toy|real] [--device D] [--kills N] [--seed N] --out result.json

- ``processes``: a driver with three processes, and the server that these are forked from; one of the five is killed,
  again and again.
- ``cluster``: a driver and a Ray cluster of three pretended machines of one core. Killed are the raylet of a machine,
  which another one replaces; an actor's process; or the driver.

Steps are those of tests of the plan, which nap and write digests of what they read; or with ``--steps real`` all of
``beam run``, of a tiny capture, by turns in segments of five frames and in one. A driver that was killed is started
again in the same folder until it ends well; then the folder must hold every output, with the bytes of a job in one
process that nobody disturbed, and nothing half written. ``executions`` over ``steps`` is what the kills cost; ``at``
counts the stages of steps that killed workers were at.
"""

from __future__ import annotations

import functools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import record
from parts import measure, say
from workers import contents

sys.path.insert(0, str(record.ROOT / "tests"))
from support.storm_takes import TAKES, begun_file, draw_capture, processes_of

from beam_warp.device.arrays import resolve_device
from beam_warp.plan.standing import look

Row = dict[str, Any]
Kill = Callable[[random.Random, int, set[int]], tuple[str, int]]
"""Called with processes of a driver and of workers so far; kills somebody, and returns what it was and its process."""

DRIVER = "import sys; from support.storm_takes import drive; drive(*sys.argv[1:])"
PACE = {"toy": 0.1, "real": 1.0}
"""Mean time from a step's beginning to the next kill [s]."""

MACHINES = 3

PATHS = os.pathsep.join(filter(None, [str(record.ROOT / "tests"), os.environ.get("PYTHONPATH")]))
"""Where drivers and workers find the steps."""


@dataclass
class Bench:
    """How many are killed at least, at which kind of steps, and on which device these are done."""

    kills: int
    seed: int
    steps: str
    device: str


def begun(out: Path) -> list[str]:
    """Return stage and process of every step that was begun in a take."""
    return begun_file(out).read_text().splitlines() if begun_file(out).exists() else []


def storm(bench: Bench, workers: str, kill: Kill) -> Iterator[Row]:
    """Carry takes out until so many were killed, and compare each with one that nobody disturbed."""
    rng, killed, at, takes, executions, steps = random.Random(bench.seed), Counter[str](), Counter[str](), 0, 0, 0

    def drive(number: int, out: Path, words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-P", "-c", DRIVER, bench.steps, str(number), str(out), words, bench.device]
        return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": PATHS})

    def undisturbed(number: int, out: Path) -> int:
        """Carry a take out in one process; return how many steps that took."""
        before = len(begun(out))
        if code := drive(number, out, "1").wait():
            raise RuntimeError(f"a driver that nobody disturbs must end well, got exit code {code}")
        return len(begun(out)) - before

    with tempfile.TemporaryDirectory() as name:
        place, kinds = Path(name), len(TAKES[bench.steps])
        if bench.steps == "real":
            draw_capture(place / "capture", bench.device)
        whole = [place / f"whole {number}" for number in range(kinds)]
        for number, out in enumerate(whole):
            out.mkdir()
            say(f"{undisturbed(number, out)} steps of a take")
        while killed.total() < bench.kills or takes < kinds:
            number, out, code = takes % kinds, place / f"take {takes}", None
            out.mkdir()
            while code != 0:
                driver = drive(number, out, workers)
                seen = len(begun(out))
                while (code := driver.poll()) is None:
                    may_kill = killed.total() < bench.kills * (takes + 1) / kinds  # each kind of take has its share
                    if may_kill and len(begun(out)) > seen:  # else nobody has begun anything that a kill could spoil
                        time.sleep(rng.uniform(0.0, 2.0 * PACE[bench.steps]))
                        lines = begun(out)
                        seen = len(lines)
                        with suppress(psutil.NoSuchProcess):
                            driver.poll()  # one that has ended is no process any more
                            what, process = kill(rng, driver.pid, {int(line.split()[1]) for line in lines})
                            killed[what] += 1
                            if what == "worker":
                                stages = [line.split()[0] for line in lines if line.endswith(f" {process}")]
                                at[stages[-1] if stages else "start"] += 1
                    time.sleep(0.005)
                if code not in (0, -signal.SIGKILL):
                    raise RuntimeError(f"the driver must end well or be killed, got exit code {code}")
            made, wanted = (contents(it) for it in (out, whole[number]))
            names = (made.keys() | wanted.keys()) - {"calls.txt"}
            differing = sorted(name for name in names if made.get(name) != wanted.get(name))
            left = [path.name for path in out.rglob(".*")]
            calls, lost = len(begun(out)), undisturbed(number, out)
            if differing or lost or left:
                raise RuntimeError(f"take {takes} must be whole, got {lost} steps lost, left {left}, other {differing}")
            takes, executions, steps = takes + 1, executions + calls, steps + len(look(out).steps)
            say(f"{takes} takes, killed {dict(killed)} at {dict(at)}")
            yield {
                "takes": takes,
                "killed": dict(killed),
                "at": dict(at),
                "kills": killed.total(),
                "executions": executions,
                "steps": steps,
            }


def processes(bench: Bench) -> Iterator[Row]:
    """Kill a driver, or twice as likely one of its three processes."""

    def kill(rng: random.Random, driver: int, known: set[int]) -> tuple[str, int]:
        children = processes_of(driver, known)
        chosen = rng.choice([psutil.Process(driver), *children, *children])
        workers = [child.pid for child in children if child.ppid() != driver]
        chosen.kill()
        if chosen.pid != driver:
            return ("worker" if chosen.pid in workers else "server"), chosen.pid
        return "driver" if workers else "driver at the end", driver

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

        def kill(rng: random.Random, driver: int, known: set[int]) -> tuple[str, int]:
            what = rng.choice(["driver", "raylet", "worker", "worker"])
            actors = [
                it for it in psutil.process_iter() if "_Actor" in it.name() or "_Actor" in "".join(it.cmdline()[:1])
            ]
            if what == "worker" and actors:
                chosen = rng.choice(actors)
                chosen.kill()
                return what, chosen.pid
            if what == "raylet":
                machine = machines.pop(rng.randrange(len(machines)))
                found.remove_node(machine, allow_graceful=False)
                machines.append(_machine(found))
                return what, 0
            psutil.Process(driver).kill()
            return "driver", driver

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
    parser = record.parser(__doc__, device=True, quick="four kills, to see whether it runs", parts=PARTS)
    parser.add_argument("--kills", type=int, default=100, help="at least, in each part")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", choices=TAKES, default="toy", help="steps that nap, or all of beam run, small")
    arguments = parser.parse_args()
    bench = Bench(4 if arguments.quick else arguments.kills, arguments.seed, arguments.steps, arguments.device)
    keep = functools.partial(record.write_result, arguments, resolve_device(arguments.device))
    measure(PARTS, bench, only=arguments.parts, keep=keep)


if __name__ == "__main__":
    main()
