"""Parts that end, leave, change or fill their process, in as many ways as the table has, each as a
policy, a renderer, a fixer, an evaluator and a served policy.

``PolicyExit``, ``RendererExit``... are made of the table below.
"""

import ctypes
import locale
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from alpasim_plugin.core.types import Frame, MetricInfo, SensorSpec
from evaluators.metrics.score import series
from policies.simple import ConstantVelocity

HOUR_S = 3600
NOTHING = "nothing_m"


def leave(value):
    sys.exit(0)


def leave_with_three(value):
    sys.exit(3)


def interrupt(value):
    raise KeyboardInterrupt


def end_generator(value):
    raise GeneratorExit


def end_process(value):
    os._exit(0)


def crash(value):
    ctypes.string_at(0)


def be_killed(value):
    os.kill(os.getpid(), signal.SIGKILL)


def be_terminated(value):
    os.kill(os.getpid(), signal.SIGTERM)


def spin(value):
    while True:
        pass


def sleep(value):
    time.sleep(HOUR_S)


def start_thread(value):
    threading.Thread(target=time.sleep, args=(HOUR_S,)).start()
    return value


def fork(value):
    os.fork()  # both copies go on
    return value


def start_process(value):
    context = multiprocessing.get_context("fork")
    context.Process(target=sleep_beside, args=(os.getpid(),), daemon=True).start()
    return value


def sleep_beside(parent):
    """Sleep as long as a parent lives: no test leaves processes."""
    while os.getppid() == parent:
        time.sleep(1.0)


def start_session(value):
    parent = os.getpid()
    if os.fork() == 0:
        os.setsid()
        sleep_beside(parent)
        os._exit(0)
    return value


def change_signals(value):
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGCHLD, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)
    return value


def change_environment(value):
    os.environ.clear()
    locale.setlocale(locale.LC_ALL, "C")
    return value


def limit_recursion(value):
    sys.setrecursionlimit(150)
    return value


def remove_folder(value):
    folder = tempfile.mkdtemp()
    os.chdir(folder)
    os.rmdir(folder)
    return value


def change_folder(value):
    os.chdir("/")
    return value


def patch_library(value):
    np.hypot = np.linalg.norm = lambda *arguments, **settings: np.float64(0.0)
    return value


def close_files(value):
    os.closerange(3, 4096)
    return value


def close_output(value):
    for stream in (sys.stdout, sys.stderr):
        stream.close()
    return value


def run_out_of_memory(value):
    raise MemoryError("10 GB")


def allocate(value):
    """Ask for 10 GB in earnest, where the system gives no more than 8: no test fills a machine."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, hard))
    return np.ones(10 << 30, dtype=np.uint8)


def recurse(value):
    return recurse(value)


def lie(value):
    """Return something else."""
    return SimpleNamespace(xy="here")


def plan_no_number(plan):
    return replace(plan, xy=np.full_like(plan.xy, np.nan))


def plan_late(plan):
    """Plan from a second on, at every step."""
    return replace(plan, times_us=plan.times_us + 1_000_000)


def plan_too_far(plan):
    """Plan 200,000 poses."""
    times_us = plan.t_us + 1_000 * np.arange(200_000)
    return replace(
        plan, times_us=times_us, xy=np.zeros((len(times_us), 2)), yaw=np.zeros(len(times_us))
    )


def plan_too_many(plan):
    """Sample 200,000 alternatives."""
    sample = np.zeros((len(plan.times_us), 3))
    return replace(plan, samples=(sample,) * 200_000)


def plan_and_say_too_much(plan):
    return replace(plan, debug={"words": "x" * 100_000_000})


FAULTS = {
    fault.__name__: fault
    for fault in (
        leave,
        leave_with_three,
        interrupt,
        end_generator,
        end_process,
        crash,
        be_killed,
        be_terminated,
        spin,
        sleep,
        start_thread,
        fork,
        start_process,
        start_session,
        change_signals,
        change_environment,
        limit_recursion,
        remove_folder,
        change_folder,
        patch_library,
        close_files,
        close_output,
        run_out_of_memory,
        allocate,
        recurse,
        lie,
    )
}
# What only a plan can be.
FAULTS_OF_PLANS = {
    fault.__name__: fault
    for fault in (
        plan_no_number,
        plan_late,
        plan_too_far,
        plan_too_many,
        plan_and_say_too_much,
    )
}
# What harms nobody but, perhaps, the part itself: its rollout may be as good as any.
HARMLESS = {
    "plan_and_say_too_much",
    "start_thread",
    "fork",
    "start_process",
    "start_session",
    "change_signals",
    "change_environment",
    "limit_recursion",
    "remove_folder",
    "change_folder",
    "patch_library",
    "close_output",
}


class Watcher(ConstantVelocity):
    """Straight on, with a camera that it does not look at."""

    sensors = (SensorSpec("front", 300_000),)


class Passing:
    """A fixer that changes nothing."""

    def reset(self, seed):
        pass

    def step(self, block, maps):
        return list(block)


def _policy(fault):
    class Bad(ConstantVelocity):
        def act(self, observation):
            return fault(super().act(observation))

    return Bad


def _renderer(fault):
    class Bad:
        def render(self, request):
            shape = (request.camera.height, request.camera.width, 3)
            return fault(
                Frame(request.t_us, request.camera.name, np.full(shape, 90, dtype=np.uint8))
            )

    return Bad


def _fixer(fault):
    class Bad(Passing):
        def step(self, block, maps):
            return [fault(replace(frame)) for frame in block]

    return Bad


def _evaluator(fault):
    class Bad:
        metrics = {NOTHING: MetricInfo("m", "lower", "max", "always nothing", margin=0.1)}  # noqa: RUF012 - as a plug-in writes it

        def __call__(self, rollout, scene):
            return fault([series(NOTHING, rollout.ego.t_us, 0.0)])

    return Bad


for _kind in (_policy, _renderer, _fixer, _evaluator):
    for _name, _fault in FAULTS.items():
        globals()[f"{_kind.__name__[1:]}_{_name}"] = _kind(_fault)
for _name, _fault in FAULTS_OF_PLANS.items():
    globals()[f"policy_{_name}"] = _policy(_fault)


if __name__ == "__main__":
    from alpasim_plugin import serve_policy

    serve_policy(_policy((FAULTS | FAULTS_OF_PLANS)[sys.argv[1]]))
