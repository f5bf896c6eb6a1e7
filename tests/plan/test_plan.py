"""Plans of steps that cost nothing: order, faults, kills, and the same bytes whoever does the work."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from contextlib import suppress
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path

import psutil
import pytest
from support.storm_takes import processes_of
from support.toy_work import toy_plan

from beam_warp.device.compilation import compilation_heard
from beam_warp.errors import InvalidOptionError, OutputError, UnfinishedError
from beam_warp.plan.carry import Patience, carry_out
from beam_warp.plan.page import left_in_words, write_page
from beam_warp.plan.processes import Processes, StepProgress
from beam_warp.plan.schedule import Schedule, State
from beam_warp.plan.standing import look, simulated
from beam_warp.plan.steps import Step, Task, is_whole, perform, read_receipt, wait_for
from beam_warp.plan.workers import InProcess, Terms


def nobody(*step, **facts):
    """Hear nothing."""


def here(plan, **options):
    return carry_out(plan, InProcess(plan.works, nobody), **options)


def processes(plan, count=2):
    return Processes(plan.works, Terms.of(plan.folder, ""), [{}] * count)


class SaidOnce:
    """A link on which one thing is said."""

    def __init__(self, said):
        self.said = said

    def recv(self):
        return self.said

    def close(self):
        """Do nothing."""


def outputs(folder):
    return {path.name: path.read_bytes() for path in (folder / "out").iterdir()}


def calls(plan):
    return plan.works["frame"].calls()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Outputs of a plan that one process carried out without a stop."""
    folder = tmp_path_factory.mktemp("whole")
    here(toy_plan(folder))
    return outputs(folder)


def test_what_steps_say_is_not_kept_in_memory(tmp_path):
    plan, said = toy_plan(tmp_path, 50, said=100_000), 100_000
    tracemalloc.start()
    receipts = here(plan)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 0.2 * len(receipts) * said
    assert len(receipts["frame-7"].facts["said"]) == said


class TestOrder:
    def test_frames_are_finished_before_others_are_begun(self, tmp_path):
        plan = toy_plan(tmp_path, 4, 2)
        here(plan)
        assert calls(plan) == [
            *("cameras", "frame-0", "light", "materials-0", "frame-1", "materials-1"),
            *("frame-2", "materials-2", "frame-3", "materials-3"),
        ]

    def test_a_segment_goes_on_first_where_another_worker_can_finish_its_frames(self, tmp_path):
        schedule, begun = Schedule(toy_plan(tmp_path, 6, 6).steps, workers=2), []
        while (step := schedule.next()) is not None:
            if 1 <= len(begun) <= 5:
                assert schedule.likely_after(step)[0].name == f"frame-{len(begun)}"
            begun.append(step.name)
            schedule.done(step.name)
        assert begun[:7] == ["cameras", *(f"frame-{frame}" for frame in range(6))]
        assert begun[7:] == ["light", *(f"materials-{frame}" for frame in range(6))]

    def test_frames_are_finished_first_where_every_worker_has_a_segment(self, tmp_path):
        schedule = Schedule(toy_plan(tmp_path, 4, 2).steps, workers=2)
        assert schedule.next().name == "cameras"
        schedule.done("cameras")
        assert [schedule.next().name for _ in range(2)] == ["frame-0", "frame-2"]
        schedule.done("frame-0")
        assert schedule.next().name == "light"

    def test_what_is_likely_next_is_next(self, tmp_path):
        schedule, guessed = Schedule(toy_plan(tmp_path, 6, 3).steps), []
        while (step := schedule.next()) is not None:
            assert step in guessed[:1] or not guessed
            guessed = schedule.likely_after(step)
            schedule.done(step.name)
        assert not guessed

    def test_a_worker_goes_on_with_what_it_has_read_unless_frames_can_be_finished(self):
        schedule = Schedule([Step("a", "s", 0, (), 1), Step("b", "s", 1, (), 1), Step("c", "s", 2, (), 2)])
        ahead = (schedule.steps["b"],)
        assert [schedule.take(schedule.first(), ahead).name for _ in range(3)] == ["c", "b", "a"]
        assert schedule.first() is None

    @pytest.mark.parametrize("steps", [[Step("a", "s"), Step("a", "s")], [Step("a", "s", None, ("b",))]])
    def test_graphs_that_are_none(self, steps):
        with pytest.raises(InvalidOptionError, match="steps must have names of their own"):
            Schedule(steps)

    def test_what_needs_a_step_that_failed_is_left_out(self):
        schedule = Schedule(
            [Step("a", "s"), Step("b", "s", None, ("a",)), Step("c", "s", None, ("b",)), Step("d", "s")]
        )
        assert schedule.next().name == "a"
        assert not schedule.failed("a")
        assert schedule.next().name == "a"
        assert schedule.failed("a")
        assert [schedule.states[name] for name in "abcd"] == [State.FAILED, State.LEFT, State.LEFT, State.READY]


class TestKeys:
    def test_nothing_is_done_twice(self, tmp_path):
        plan = toy_plan(tmp_path)
        first, again = here(plan), here(plan)
        assert len(calls(plan)) == len(plan.steps)
        assert all(receipt.is_kept for receipt in again.values())
        assert {name: receipt.key for name, receipt in first.items()} == {name: again[name].key for name in again}

    def test_other_options_start_over(self, tmp_path):
        here(toy_plan(tmp_path, 4))
        other = here(toy_plan(tmp_path, 4, options="other"))
        assert not any(receipt.is_kept for receipt in other.values())

    def test_a_changed_image_costs_its_frame_and_what_follows(self, tmp_path, monkeypatch):
        plan = toy_plan(tmp_path, 10)
        here(plan)
        work = plan.works["frame"]
        monkeypatch.setattr(type(work), "digest", lambda self, step: f"image {step.frame}{' new' * (step.frame == 8)}")
        made = {name for name, receipt in here(plan).items() if not receipt.is_kept}
        assert made == {"frame-8", "materials-8", "frame-9", "materials-9"}

    @pytest.mark.parametrize("harm", ["gone", "cut", "spoiled", "receipt"])
    def test_what_is_damaged_is_made_again_and_nothing_else(self, tmp_path, whole, harm):
        plan = toy_plan(tmp_path)
        here(plan)
        path = tmp_path / "out" / "frame-7.bin"
        content = path.read_bytes()
        if harm == "gone":
            path.unlink()
        elif harm == "receipt":
            (tmp_path / "steps" / "frame-7.json").write_text('{"key": 3}')
        else:
            path.write_bytes(content[:-1] if harm == "cut" else b"x" + content[1:])
        assert [name for name, receipt in here(plan).items() if not receipt.is_kept] == ["frame-7"]
        assert outputs(tmp_path) == whole

    def test_an_input_that_rots_unseen_is_made_again_when_it_is_read(self, tmp_path, whole):
        """Same size and time, other bytes: who reads it fails, which is no fault of its own."""
        plan = toy_plan(tmp_path)
        here(plan)
        path = tmp_path / "out" / "frame-7.bin"
        before = path.stat()
        path.write_bytes(b"x" + path.read_bytes()[1:])
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        (tmp_path / "out" / "materials-7.bin").unlink()
        here(plan)
        assert outputs(tmp_path) == whole


class TestStanding:
    def test_an_estimate_is_what_the_schedule_does(self, tmp_path):
        """One worker takes the sum of all steps; many take the longest way: cameras, five frames, materials."""
        steps = toy_plan(tmp_path).steps
        seconds = dict.fromkeys(("cameras", "frame", "light", "materials"), 1.0)
        assert simulated(steps, (), seconds, 1) == len(steps) == 42
        assert simulated(steps, (), seconds, 100) == 1 + 5 + 1
        kept = [step.name for step in steps if step.stage != "materials"]
        assert simulated(steps, kept, seconds, 4) == 20 / 4
        assert simulated(steps, (), seconds | {"frame": 9.0}, 2) >= (42 + 20 * 8) / 2

    def test_a_job_that_was_stopped(self, tmp_path):
        plan = toy_plan(tmp_path, faults={"frame-3": "full"})
        with pytest.raises(OutputError):
            here(plan)
        standing = look(tmp_path)
        assert {stage: found.done for stage, found in standing.stages.items()} == {
            **{"cameras": 1, "frame": 3, "materials": 3, "light": 1}
        }
        assert not standing.is_live
        assert standing.seconds_left(2) < standing.seconds_left(1)
        assert "34 of 42 steps are left: about" in left_in_words(standing)
        (tmp_path / "out" / "frame-1.bin").unlink()
        assert look(tmp_path).stages["frame"].done == 2

    def test_a_page_shows_what_failed(self, tmp_path):
        plan = toy_plan(tmp_path, 2, faults={"frame-1": "raise"})
        with pytest.raises(UnfinishedError):
            here(plan)
        write_page(look(tmp_path), tmp_path / "page.html")
        page = (tmp_path / "page.html").read_text()
        assert "<li>frame-1: ValueError: a poisoned frame</li>" in page
        assert page.count("<figure>") == 2
        assert page.count("frame: failed") == page.count("materials: open") == 1

    def test_no_plan(self, tmp_path):
        with pytest.raises(InvalidOptionError, match=r"out must be the folder of a job .* is not there"):
            look(tmp_path)


class TestFaults:
    def test_a_poisoned_frame_is_tried_twice_and_the_rest_goes_on(self, tmp_path, whole):
        plan = toy_plan(tmp_path, faults={"frame-8": "raise", "materials-2": "raise once"})
        with pytest.raises(UnfinishedError, match=r"1 of 42 .* twice \(frame-8: ValueError: a poisoned frame\)"):
            here(plan)
        assert calls(plan).count("frame-8") == calls(plan).count("materials-2") == 2
        assert whole.keys() - outputs(tmp_path).keys() == {
            f"{s}-{f}.bin" for f in (8, 9) for s in ("frame", "materials")
        }
        assert "poisoned" in (tmp_path / "plan" / "frame-8.txt").read_text()
        assert look(tmp_path).given_up == ("frame-8",)
        here(toy_plan(tmp_path))
        assert outputs(tmp_path) == whole

    def test_nothing_goes_on_without_what_all_need(self, tmp_path):
        plan = toy_plan(tmp_path, faults={"light": "raise"})
        with pytest.raises(ValueError, match="poisoned"):
            here(plan)
        assert calls(plan) == ["cameras", "frame-0", "light", "light"]

    def test_a_full_disk_ends_the_job_at_once(self, tmp_path):
        plan = toy_plan(tmp_path, faults={"frame-3": "full"})
        with pytest.raises(OutputError, match="No space left"):
            here(plan)
        assert "frame-4" not in calls(plan)

    def test_files_that_appear_late_are_waited_for(self, tmp_path):
        late = tmp_path / "late"
        threading.Timer(0.3, late.write_bytes, (b"1234",)).start()
        wait_for([(str(late), 4)], patience=10.0)
        with pytest.raises(OSError, match="must be visible to all workers, got none of 5 bytes"):
            wait_for([(str(late), 5)], patience=0.2)

    def test_receipts_prove_the_bytes(self, tmp_path):
        plan = toy_plan(tmp_path, 1)
        step = plan.steps[0]
        receipt = perform(plan.works, Task(step), nobody)
        assert read_receipt(tmp_path, step.name) == receipt
        assert is_whole(tmp_path, receipt, is_read=True)
        assert not is_whole(tmp_path, replace(receipt, outputs={"out/other.bin": (1, 2, "3")}))


class TestProcesses:
    def test_the_same_bytes_as_one_process(self, tmp_path, whole):
        plan = toy_plan(tmp_path, seconds=0.1)
        receipts = carry_out(plan, processes(plan))
        assert outputs(tmp_path) == whole
        assert len({receipt.worker for receipt in receipts.values()}) == 2
        assert not list(tmp_path.rglob(".*"))

    def test_faults_of_every_kind(self, tmp_path, whole):
        """Killed from outside, ended by what it does, hanging: each costs a try; who does so always is given up."""
        faults = {"frame-1": "kill once", "frame-6": "exit once", "materials-6": "hang once", "materials-3": "hang"}
        plan = toy_plan(tmp_path, faults=faults | {"materials-9": "exit", "frame-11": "raise"})
        heard = []
        with pytest.raises(UnfinishedError, match="got 3 of 42 that failed twice"):
            carry_out(plan, processes(plan), lambda step, receipt, error: heard.append(error), Patience(20.0, 1.0, 1.0))
        lost = {f"frame-{frame}.bin" for frame in range(11, 15)} | {
            f"materials-{f}.bin" for f in (3, 9, *range(11, 15))
        }
        assert whole.keys() - outputs(tmp_path).keys() == lost
        for said, count in (("SIGKILL", 1), ("exit code 3", 3), ("took more than", 3), ("poisoned", 2)):
            assert sum(said in error for error in heard) == count, said

    @pytest.mark.skipif(sys.platform == "win32", reason="processes are not forked")
    @pytest.mark.parametrize(("fault", "says"), [("kill once", "exit code 255"), ("hang once", "took more than")])
    def test_a_process_outlives_the_one_it_was_forked_from(self, tmp_path, whole, fault, says):
        plan, heard = toy_plan(tmp_path, faults={"frame-2": fault}), []
        workers = processes(plan, 1)
        (worker,) = map(psutil.Process, workers.processes())
        server = worker.parent()
        assert server != psutil.Process()

        def harm(step, receipt, error):
            heard.append(error)
            if step.name == "frame-1":
                server.kill()
                while server.status() != psutil.STATUS_ZOMBIE:
                    time.sleep(0.01)
                assert not multiprocessing.active_children()  # as far as anybody can tell

        carry_out(plan, workers, harm, Patience(1.0, 1.0, 1.0))
        assert outputs(tmp_path) == whole
        assert [error for error in heard if error] == [next(error for error in heard if says in error)]

    @pytest.mark.skipif(sys.platform == "win32", reason="processes are not forked")
    def test_a_server_that_refuses_while_it_is_taken_down(self, tmp_path, whole, monkeypatch):
        """The killed server counts as running for a while, so that no other one is started."""
        connect, end = forkserver.connect_to_new_process, time.monotonic() + 0.3

        def late(fds):
            if time.monotonic() < end:
                raise ConnectionRefusedError
            return connect(fds)

        monkeypatch.setattr("multiprocessing.popen_forkserver.forkserver.connect_to_new_process", late)
        plan = toy_plan(tmp_path)
        carry_out(plan, processes(plan))
        assert outputs(tmp_path) == whole

    def test_who_is_at_a_segment_goes_on_and_the_other_one_does_the_rest(self, tmp_path):
        plan = toy_plan(tmp_path, 12, 12, seconds=0.1)
        receipts = carry_out(plan, processes(plan))
        assert len({receipts[f"frame-{frame}"].worker for frame in range(12)}) == 1
        last = max(receipts[f"frame-{frame}"].ended for frame in range(12))
        assert sum(receipts[f"materials-{frame}"].ended < last for frame in range(12)) >= 6

    def test_work_that_cannot_be_sent(self, tmp_path):
        plan = toy_plan(tmp_path, 1, faults={"frame-0": lambda: None})
        with pytest.raises(InvalidOptionError, match="work must be picklable"):
            processes(plan)

    def test_what_a_process_says_of_its_steps_is_heard(self, tmp_path):
        plan, heard = toy_plan(tmp_path), []
        told = Processes(plan.works, Terms.of(tmp_path, ""), [{}], lambda *said, **words: heard.append(words))
        carry_out(plan, told)
        assert [words["note"] for words in heard] == calls(plan)
        assert all((words["stage"], words["done"], words["total"]) == ("toy", 1, 1) for words in heard)

    def test_one_process_speaks_of_a_stage_at_a_time(self, tmp_path):
        """A bar that jumps from frame to frame says nothing."""
        plan, heard = toy_plan(tmp_path), []
        told = Processes(plan.works, Terms.of(tmp_path, ""), [{}] * 2, lambda *said, **words: heard.append(words))
        for member in told._members:
            told._hear(member)  # they are ready
        first, second = told._members
        for member, done in ((first, 1), (second, 2), (first, 3)):
            member.link = SaidOnce(StepProgress("fit", done, 9, ""))
            told._hear(member)
        told._done(first)
        second.link = SaidOnce(StepProgress("fit", 4, 9, ""))
        told._hear(second)
        told.close()
        assert [words["done"] for words in heard] == [1, 3, 4]

    def test_what_processes_compile_is_heard(self, tmp_path):
        plan, heard = toy_plan(tmp_path, faults={"frame-0": "compile"}), []
        with compilation_heard(lambda module_count, seconds, *, is_running: heard.append((module_count, seconds))):
            carry_out(plan, Processes(plan.works, Terms.of(tmp_path, "cpu"), [{}]))
        assert (2, 1.5) in heard

    @pytest.mark.parametrize(
        ("changed", "says"),
        [
            ({"code": "0" * 32}, "workers must run this version of beam-warp, got other code"),
            ({"device": "cuda"}, "workers must have a GPU, got none"),
            ({"token": "no such file"}, "out must be a folder that all workers share"),
        ],
    )
    def test_workers_that_would_give_other_bytes(self, tmp_path, changed, says):
        if changed.get("device") and Path("/dev/nvidia0").exists():
            pytest.skip("this machine has a GPU")
        plan = toy_plan(tmp_path, 1)
        workers = Processes(plan.works, replace(Terms.of(tmp_path, ""), **changed), [{}])
        with pytest.raises((InvalidOptionError, OutputError), match=says):
            carry_out(plan, workers)


DRIVER = """
import sys
from pathlib import Path
from support.toy_work import toy_plan
from beam_warp.plan.carry import carry_out
from beam_warp.plan.processes import Processes
from beam_warp.plan.workers import InProcess, Terms

if __name__ == "__main__":
    folder, count = Path(sys.argv[1]), int(sys.argv[2])
    plan = toy_plan(folder, seconds=0.04)
    few = InProcess(plan.works, lambda *step, **facts: None)
    carry_out(plan, Processes(plan.works, Terms.of(folder, ""), [{}] * count) if count > 1 else few)
"""


BARE = """
import sys
from pathlib import Path
from support.toy_work import toy_plan
from beam_warp.plan.carry import carry_out
from beam_warp.plan.processes import Processes
from beam_warp.plan.workers import Terms

class Own(str):
    pass

folder = Path(sys.argv[1])
with (folder / "runs.txt").open("a") as runs:
    runs.write("x")
if __name__ == "__main__" or sys.argv[2] == "text":
    plan = toy_plan(folder, 3, options=Own("o") if sys.argv[2] == "own" else "o")
    carry_out(plan, Processes(plan.works, Terms.of(folder, ""), [{}] * 2))
"""


@pytest.mark.parametrize("held", ["text", "own"])
def test_processes_run_a_script_again_only_for_what_is_defined_in_it(tmp_path, held):
    """The first has no guard, as scripts of users have none; works of the second hold a class of its own.

    One process may have done all before the other has run the script.
    """
    script = tmp_path / "script.py"
    script.write_text(BARE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, script, tmp_path, held], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    runs = (tmp_path / "runs.txt").read_text()
    assert runs == "x" if held == "text" else len(runs) in (2, 3)
    assert len(outputs(tmp_path)) == 8


def begun(folder):
    """How often a step was begun."""
    return (folder / "calls.txt").read_text().count("\n") if (folder / "calls.txt").exists() else 0


def kill_one(driver, rng):
    """Kill a driver, or twice as likely one of its workers; return how many were there to be killed."""
    with suppress(psutil.NoSuchProcess):
        workers = processes_of(driver)
        rng.choice([psutil.Process(driver), *workers, *workers]).kill()
        return 1
    return 0


def storm(folder, kills, workers, seed):
    """Carry plans of 20 frames out while random processes are killed, the driver too; yield the folder of each."""
    rng, script, killed = random.Random(seed), folder / "driver.py", 0
    script.write_text(DRIVER)
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
    while killed < kills:
        (out := folder / f"after {killed} kills").mkdir()
        code, seen = None, 0
        while code != 0:
            arguments = [sys.executable, "-P", str(script), str(out), str(workers)]
            driver = subprocess.Popen(arguments, env={**os.environ, "PYTHONPATH": paths})
            while (code := driver.poll()) is None:
                if (
                    killed < kills and (count := begun(out)) > seen
                ):  # else nobody has begun anything that a kill could spoil
                    seen = count
                    time.sleep(rng.uniform(0.0, 0.06))
                    killed += kill_one(driver.pid, rng)
                time.sleep(0.005)
            assert code in (0, -signal.SIGKILL)
        yield out


@pytest.mark.parametrize(
    ("kills", "workers"), [(2, 1), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((30, 1), (100, 3)))]
)
def test_a_storm_of_kills_changes_no_byte(tmp_path, whole, kills, workers):
    """Workers and drivers are killed at random, whatever they are at: in the end all is there, and nothing else."""
    for out in storm(tmp_path, kills, workers, seed=kills):
        assert outputs(out) == whole
        here(toy_plan(out))
        assert not list(out.rglob(".*"))
