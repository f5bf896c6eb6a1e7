"""Plans on a Ray cluster of three pretended machines, of which some are killed."""

import os
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from support.toy_work import toy_plan

from beam_warp.errors import InvalidOptionError, MissingPackageError
from beam_warp.jobs.listeners import no_progress
from beam_warp.plan.carry import carry_out
from beam_warp.plan.crew import crew_of
from beam_warp.plan.workers import InProcess


def outputs(folder):
    return {path.name: path.read_bytes() for path in (folder / "out").iterdir()}


def test_ray_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingPackageError, match=r"pip install beam-warp\[cluster\]"):
        crew_of("ray", None)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Three raylets of this machine, one core each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("cluster"))  # Ray's processes import from here first
        patch.setenv("PYTHONPATH", paths)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        patch.setenv("RAY_ADDRESS", found.address)
        yield found
        found.shutdown()


@pytest.mark.slow
def test_machines_are_killed_and_join(cluster, tmp_path):
    here = toy_plan(tmp_path / "here")
    carry_out(here, InProcess(here.works, no_progress))
    plan = toy_plan(tmp_path / "there", seconds=0.3)
    first, second = (cluster.add_node(num_cpus=1) for _ in range(2))

    heard = []

    def harm(step, receipt, error):
        """Let a machine join and another one die, in the midst of what it does; twice."""
        heard.append(error)
        if len(heard) in (5, 20):
            cluster.add_node(num_cpus=1)
            cluster.remove_node(first if len(heard) == 5 else second, allow_graceful=False)

    receipts = carry_out(plan, crew_of("ray", None)(plan, "", no_progress), harm)
    assert outputs(tmp_path / "there") == outputs(tmp_path / "here")
    assert len({receipt.worker for receipt in receipts.values()}) > 2


@pytest.mark.parametrize(("words", "share", "count"), [("ray", 1.0, 2), ("3@ray", 1.0 / 3.0, 6)])
def test_actors_share_gpus(tmp_path, monkeypatch, words, share, count):
    """A cluster of two GPUs, which a mock stands in for."""
    ray = MagicMock()
    ray.cluster_resources.return_value = {"GPU": 2.0}
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr("beam_warp.plan.cluster._require_open", lambda address: None)
    workers = crew_of(words, None)(toy_plan(tmp_path), "cuda", no_progress)
    assert workers.count == count
    assert ray.remote.call_args.kwargs["num_gpus"] == pytest.approx(share)


@pytest.mark.parametrize("words", ["ray", "ray://127.0.0.1:1"])
def test_no_cluster_at_an_address(tmp_path, monkeypatch, words):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    plan = toy_plan(tmp_path, 1)
    with pytest.raises(InvalidOptionError, match=r"workers must name a Ray cluster that runs, got none at .*refused"):
        crew_of(words, None)(plan, "", no_progress)
