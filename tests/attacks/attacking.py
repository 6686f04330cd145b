"""What the attacks share: random cases for some seconds, processes to kill, small runs."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress

import torch
from commands import ROOT, SMALL
from run_configs import compose_config

from safe_rl.training.train import train

SEED = int(os.environ.get("ATTACK_SEED") or time.time())
"""Every week another one; a failure names it, and ATTACK_SEED=… repeats it."""
RUN = (*SMALL, "critic_update.minibatch_size=20", "checkpoint.interval=0", "seed=3")


SCALE = float(os.environ.get("ATTACK_SCALE", 1))
"""Factor of all durations: 0 tries a case or a few of each attack."""


def cases(name, seconds, least=3):
    """Random generators, one per case, for about so many seconds."""
    end, number = time.monotonic() + SCALE * seconds, 0
    least = least if SCALE else 1
    while number < least or time.monotonic() < end:
        case = f"{name} ATTACK_SEED={SEED} case {number}"
        print(case, flush=True)  # pytest shows it if the case fails
        yield random.Random(case)
        number += 1
    print(f"{name}: {number} cases", file=sys.__stderr__, flush=True)


def begin_or_continue(folder, words):
    """Train in a folder by a configuration."""
    train(compose_config(*words), folder, continues=(folder / "config.yaml").exists())


SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["safe_rl.cli.python_api", "safe_rl.training.train"])


def exit_code_of(work, *arguments):
    """Call a function in a process of its own, which has imported everything in no time."""
    process = SERVER.Process(target=_in_one_thread, args=(work, *arguments), daemon=True)
    process.start()
    process.join(300)
    assert process.exitcode is not None, "it hangs"
    return process.exitcode


def _in_one_thread(work, *arguments):
    torch.set_num_threads(1)
    work(*arguments)


def start(*words, limits="", **environment):
    """A process of its own group; `limits` are commands of the shell before it."""
    outside = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    # below nohup and in the background these signals are ignored
    command = f'{limits} exec env --default-signal=INT,HUP "$@"'
    return subprocess.Popen(
        ["bash", "-c", command, "bash", sys.executable, *words],
        cwd=ROOT, env=outside | environment, start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def said_by(process, patience=300):
    """What a process printed until its end; it must end."""
    try:
        return process.communicate(timeout=patience)[0]
    finally:
        kill_all(process)


def kill_all(process):
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
