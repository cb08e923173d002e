"""Executors: every task ends in exactly one outcome, even if its worker dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from physion.compute.local import LocalExecutor, SerialExecutor
from physion.compute.tasks import Executor, executors
from physion.core.errors import PhysionError
from support.tasks import die_on_two, die_once, fail_on_three


def square(number: int) -> int:
    return number * number


def disk_full(number: int) -> int:
    raise OSError(28, "No space left on device")


def leave(number: int) -> int:
    os._exit(number)


def hang(number: int) -> int:
    if number == 1:
        time.sleep(600)
    return number


def process_of(number: int) -> int:
    """Return the number of the process."""
    return os.getpid()


class Unloadable:
    """Function that can be sent to another process but not be read there."""

    def __call__(self, number: int) -> int:
        return number

    def __reduce__(self) -> tuple[object, tuple[int]]:
        return leave, (3,)


def unsendable(number: int) -> object:
    return lambda: number


def numbers(*values: int) -> dict[str, int]:
    return {f"task {value}": value for value in values}


@pytest.mark.parametrize("executor", [SerialExecutor(), LocalExecutor(1), LocalExecutor(2)])
def test_every_task_has_one_outcome(executor: Executor) -> None:
    outcomes = list(executor.map(square, numbers(*range(20))))
    assert {o.key: o.value for o in outcomes} == {f"task {n}": n * n for n in range(20)}
    assert len(outcomes) == 20


@pytest.mark.parametrize("executor", [SerialExecutor(), LocalExecutor(2)])
def test_nothing_to_do_ends_at_once(executor: Executor) -> None:
    assert list(executor.map(square, {})) == []


@pytest.mark.parametrize("executor", [SerialExecutor(), LocalExecutor(1)])
def test_an_exception_fails_only_its_task_and_is_not_tried_again(executor: Executor) -> None:
    outcomes = {o.key: o for o in executor.map(fail_on_three, numbers(1, 2, 3, 4))}
    bad = outcomes.pop("task 3")
    assert bad.error == "three is not liked" and bad.tries == 1
    assert "fail_on_three" in bad.traceback
    with pytest.raises(PhysionError, match="task 3: three"):
        _ = bad.value
    assert {key: o.value for key, o in outcomes.items()} == numbers(1, 2, 4)


@pytest.mark.parametrize("executor", [SerialExecutor(), LocalExecutor(1)])
def test_system_errors_keep_their_number(executor: Executor) -> None:
    (outcome,) = executor.map(disk_full, numbers(1))
    assert outcome.errno == 28 and "No space left" in str(outcome.error)


def test_a_poison_task_is_put_aside_after_three_deaths() -> None:
    outcomes = {o.key: o for o in LocalExecutor(2).map(die_on_two, numbers(*range(6)))}
    bad = outcomes.pop("task 2")
    assert bad.tries == 3 and "SIGKILL" in str(bad.error)
    assert sorted(o.value for o in outcomes.values()) == [0, 1, 3, 4, 5]
    assert all(o.tries == 1 for o in outcomes.values()), "only the culprit is blamed"


def test_a_task_whose_worker_was_killed_runs_again(tmp_path: Path) -> None:
    (outcome,) = LocalExecutor(1).map(die_once, {"a": str(tmp_path / "marker")})
    assert outcome.value == "second try" and outcome.tries == 2


def test_a_process_is_kept_in_a_block_and_ends_with_it() -> None:
    with LocalExecutor(1) as executor:
        (first,) = executor.map(process_of, numbers(1))
        with executor:
            (second,) = executor.map(process_of, numbers(1))
        squares = {o.key: o.value for o in executor.map(square, numbers(3, 4, 5))}
        assert squares == {"task 3": 9, "task 4": 16, "task 5": 25}
        (third,) = executor.map(process_of, numbers(1))
        assert first.value == second.value == third.value
        assert first.value in {child.pid for child in multiprocessing.active_children()}
    assert first.value not in {child.pid for child in multiprocessing.active_children()}
    (last,) = executor.map(process_of, numbers(1))
    assert last.value != first.value


def test_processes_that_were_not_needed_are_kept() -> None:
    """A second process may still be starting when the only task is done."""
    with LocalExecutor(2) as executor:
        for _ in range(3):
            assert [o.value for o in executor.map(square, numbers(3, 4))] in ([9, 16], [16, 9])
            assert len(multiprocessing.active_children()) == 2


def test_a_kept_process_that_dies_is_replaced() -> None:
    with LocalExecutor(1) as executor:
        (first,) = executor.map(process_of, numbers(1))
        os.kill(first.value, signal.SIGKILL)
        (second,) = executor.map(process_of, numbers(1))
        assert second.error is None and second.value != first.value


def test_a_function_that_processes_cannot_load_is_reported() -> None:
    (outcome,) = LocalExecutor(1, tries=2).map(Unloadable(), numbers(1))
    assert outcome.error == "the worker process ended with exit code 3" and outcome.tries == 2


def test_exit_code_of_a_worker_is_reported() -> None:
    (outcome,) = LocalExecutor(1, tries=1).map(leave, {"a": 7})
    assert outcome.error == "the worker process ended with exit code 7"


@pytest.mark.slow
def test_a_hanging_task_is_ended_and_the_others_go_on() -> None:
    executor = LocalExecutor(1, tries=1, timeout=5.0)
    outcomes = {o.key: o for o in executor.map(hang, numbers(1, 2, 3))}
    assert "still running" in str(outcomes["task 1"].error)
    assert [outcomes[f"task {n}"].value for n in (2, 3)] == [2, 3]


def test_a_result_that_cannot_travel_is_a_failure() -> None:
    (outcome,) = LocalExecutor(1).map(unsendable, {"a": 1})
    assert "cannot be sent" in str(outcome.error)


def test_closing_the_iterator_ends_the_workers() -> None:
    executor = LocalExecutor(2)
    outcomes = executor.map(hang, numbers(0, 1, 2))
    next(outcomes)
    assert len(multiprocessing.active_children()) == 2
    outcomes.close()  # type: ignore[attr-defined]
    assert not multiprocessing.active_children()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
def test_workers_end_when_the_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "import time\n"
        "from physion.compute.local import LocalExecutor\n"
        "if __name__ == '__main__':\n"
        "    for o in LocalExecutor(1).map(time.sleep, {'a': 0.0, 'b': 3.0, 'c': 600.0}):\n"
        "        print(o.key, flush=True)\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None and parent.stdout.readline() == "a\n"
    children = _children(parent.pid)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 120
    while any(_runs(child) for child in children) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert children and not any(_runs(child) for child in children)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="there are no process groups here")
def test_ctrl_c_while_a_worker_imports_prints_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "slow_tasks.py").write_text(
        "import os, time\n"
        "if 'STARTED' in os.environ:\n"
        "    print('importing', flush=True)\n"
        "    time.sleep(60)\n"
        "def same(value): return value\n"
    )
    script = tmp_path / "program.py"
    script.write_text(
        "import os, sys\n"
        "from physion.compute.local import LocalExecutor\n"
        "if __name__ == '__main__':\n"
        "    from slow_tasks import same\n"
        "    os.environ['STARTED'] = '1'\n"
        "    try:\n"
        "        list(LocalExecutor(1).map(same, {'a': 1}))\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
    )
    program = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Programs that a shell starts in the background ignore Ctrl-C, and so do their children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert program.stdout is not None and program.stdout.readline() == "importing\n"
    os.killpg(program.pid, signal.SIGINT)
    _, errors = program.communicate(timeout=300)
    assert (program.returncode, errors) == (130, "")


def test_a_script_without_a_main_guard_is_refused_with_the_reason(tmp_path: Path) -> None:
    script = tmp_path / "careless.py"
    script.write_text(
        "from physion.compute.local import LocalExecutor\n"
        "print(list(LocalExecutor(1).map(abs, {'a': 1})))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode != 0 and "if __name__ == '__main__'" in done.stderr


def test_registry_and_bad_numbers() -> None:
    assert executors.get("local") is LocalExecutor
    assert LocalExecutor().workers >= 1
    with pytest.raises(PhysionError, match="at least 1"):
        LocalExecutor(0)


def _children(parent: int) -> set[int]:
    folder = Path(f"/proc/{parent}/task")
    lists = [(task / "children").read_text().split() for task in folder.iterdir()]
    return {int(child) for children in lists for child in children}


def _runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] not in "ZX"
    except FileNotFoundError:
        return False
